// The charts of the report: latency over time, its distribution, the hops, the slots of a plan.

/** All publish slots of all recordings, each once. */
function slotsOf(recordings) {
  const seen = new Map();
  for (const one of recordings) for (const slot of one.slots) seen.set(slot.join(), slot);
  return [...seen.values()];
}

function shadeSlots(layer, scale, box, slots, vertical) {
  for (const [start, end] of slots) {
    const from = vertical ? scale.x(start) : scale.y(end);
    const length = Math.max(1, vertical ? scale.x(end) - from : scale.y(start) - from);
    draw(layer, "rect", vertical
      ? { x: from, y: box.top, width: length, height: box.height, fill: "var(--slot)", opacity: 0.35 }
      : { x: box.left, y: from, width: box.width, height: length, fill: "var(--slot)", opacity: 0.35 });
  }
}

/** The range of undisturbed latencies and slots, with a little air. */
function latencyRange(recordings) {
  let low = Infinity, high = -Infinity;
  for (const { histogram: { width, bin }, slots } of recordings) {
    if (bin.length) {
      low = Math.min(low, bin[0] * width);
      high = Math.max(high, (bin[bin.length - 1] + 1) * width);
    }
    for (const [start, end] of slots) [low, high] = [Math.min(low, start), Math.max(high, end)];
  }
  if (low > high) return [0, 1e6];
  const air = Math.max((high - low) * 0.04, high * 1e-4);
  return [low < 0.25 * high ? 0 : low - air, high + air];
}

function plotOverTime(host, recordings, openCycle) {
  const slots = slotsOf(recordings), range = latencyRange(recordings);
  const last = Math.max(1, ...recordings.map((one) => one.points.time.at(-1) ?? 0));
  const marks = recordings.map(({ points }) => {
    const hit = new Set(points.disturbed);
    return points.cycle.map((cycle, n) =>
      ({ cycle, time: points.time[n], latency: points.latency[n], hit: hit.has(n) }));
  });
  legend(host, recordings.map((one) => `${one.name} (${one.points.of} cycles)`));

  function paint(layer, scale, view, box) {
    shadeSlots(layer, scale, box, slots, false);
    marks.forEach((list, number) => {
      const dots = [], crosses = [], above = [];
      for (const { time, latency, hit } of list) {
        if (time < view.x[0] || time > view.x[1] || latency < view.y[0]) continue;
        const x = scale.x(time).toFixed(1), y = scale.y(latency).toFixed(1);
        if (latency > view.y[1]) above.push(`M${x} ${box.top - 5}l4 7h-8z`);
        else if (hit) crosses.push(`M${x} ${y}m-3-3l6 6m0-6l-6 6`);
        else dots.push(`M${x} ${y}h0`);
      }
      const stroke = colour(number);
      draw(layer, "path", { d: dots.join(""), stroke, "stroke-width": 3.6, "stroke-linecap": "round" });
      draw(layer, "path", { d: crosses.join(""), stroke, fill: "none", "stroke-width": 1.2 });
      draw(layer, "path", { d: above.join(""), fill: stroke });
      const gaps = recordings[number].points.incomplete.filter((time) => time <= view.x[1])
        .map((time) => `M${scale.x(time).toFixed(1)} ${box.top + box.height}v-8`);
      draw(layer, "path", { d: gaps.join(""), stroke: "var(--bad)", "stroke-width": 1.5 });
    });
  }

  function points(view) {
    return marks.flatMap((list, number) => list
      .filter(({ time, latency }) =>
        time >= view.x[0] && time <= view.x[1] && latency >= view.y[0])
      .map(({ cycle, time, latency, hit }) => ({
        x: time, y: latency, go: () => openCycle(number, cycle),
        text: `${recordings[number].name}, cycle ${cycle}\n${ms(latency)} ms`
          + `${hit ? ", disturbed by the machine" : ""}\nbegan after ${(time / 1e9).toFixed(3)} s`,
      }))).sort((a, b) => a.x - b.x);
  }

  chart(host, {
    label: "Latency of every cycle over time", height: 320, zoom: "xy", paint, points,
    x: { range: [0, last], label: "since the first cycle [s]", unit: 1e9 },
    y: { range, label: "latency [ms]", unit: 1e6 },
  });
  const few = recordings.filter((one) => one.points.cycle.length < one.points.of).map((one) =>
    `Of ${one.points.of} cycles of ${one.name} ${one.points.cycle.length} are drawn: of every `
    + "stretch the shortest and the longest, disturbed and not, and of the others every n-th.");
  caption(host, ["Crosses: disturbed by the machine. Triangles: beyond the axis. Red ticks: "
    + "incomplete cycles. Grey: publish slots. Drag to zoom, double click or Escape to go back; "
    + "arrow keys walk through the cycles, Enter or a click opens one below.", ...few].join(" "));
}

/**
 * Fine bins joined to some 80 over a recording's own spread in the view, but none narrower than a
 * pixel; widths stay 1, 2 or 5 times a power of ten. Narrow bands are shown where they are: pixel
 * by pixel.
 */
function joined({ width, bin, count }, view) {
  const inside = bin.filter((number) => (number + 1) * width > view[0] && number * width < view[1]);
  if (!inside.length) return [];
  const spread = (inside[inside.length - 1] + 1 - inside[0]) * width;
  const pixel = (view[1] - view[0]) / 800;
  const narrow = new Set(inside.map((number) => Math.floor(number * width / pixel))).size < 40;
  const rough = narrow ? pixel : Math.max(spread / 80, pixel);
  const power = 10 ** Math.floor(Math.log10(rough));
  const wanted = power * [1, 2, 5, 10].find((factor) => factor * power >= rough);
  const step = Math.max(width, wanted), sums = new Map();
  bin.forEach((number, n) => {
    const at = Math.floor(number * width / step);
    sums.set(at, (sums.get(at) ?? 0) + count[n]);
  });
  return [...sums].map(([at, total]) => ({ from: at * step, to: (at + 1) * step, total }))
    .filter(({ from, to }) => to > view[0] && from < view[1]);
}

const kind = ({ timeline }) => timeline.watched ? "undisturbed" : "complete";
const sampleSize = ({ histogram }) => histogram.count.reduce((sum, one) => sum + one, 0);

/** One histogram per recording, one above the other, on the same axis of latency. */
function plotHistogram(host, recordings) {
  const slots = slotsOf(recordings), range = latencyRange(recordings);
  const sizes = recordings.map(sampleSize), count = recordings.length;
  legend(host, recordings.map((one, number) => `${one.name} (${sizes[number]} ${kind(one)} cycles)`));
  const bars = (view) => recordings.map(({ histogram }, number) => {
    const found = joined(histogram, view.x), top = Math.max(1, ...found.map((bar) => bar.total));
    const base = count - 1 - number;
    return found.map((bar) => ({ ...bar, number, base, high: base + 0.9 * bar.total / top, top }));
  });
  chart(host, {
    label: "Histogram of the latency", height: 70 + 110 * count, zoom: "x",
    x: { range, label: "latency [ms]", unit: 1e6 },
    y: { range: [0, count], label: "cycles", bare: true },
    paint(layer, scale, view, box) {
      shadeSlots(layer, scale, box, slots, true);
      for (const list of bars(view)) {
        for (const bar of list) {
          const x = scale.x(bar.from), y = scale.y(bar.high);
          draw(layer, "rect", { x, y, width: Math.max(1.5, scale.x(bar.to) - x - 0.5),
            height: scale.y(bar.base) - y, fill: colour(bar.number) });
        }
        if (list.length) {
          draw(layer, "text", { x: box.left + 5, y: scale.y(list[0].base + 0.9) + 10 },
            `highest: ${list[0].top}`);
        }
      }
    },
    points: (view) => bars(view).flat().map((bar) => ({
      x: (bar.from + bar.to) / 2, y: bar.high,
      text: `${recordings[bar.number].name}\n${bar.total} of ${sizes[bar.number]} cycles\n`
        + `in [${ms(bar.from)}, ${ms(bar.to)}) ms`,
    })).sort((a, b) => a.x - b.x),
  });
  caption(host, "Without cycles that the machine disturbed, each recording on a scale of its own. Grey: publish slots. "
    + "Zooming in makes the bins finer; every cycle is counted.");
}

function plotDistribution(host, recordings) {
  const slots = slotsOf(recordings), range = latencyRange(recordings);
  const curves = recordings.map((one) => {
    const { width, bin, count } = one.histogram, size = sampleSize(one);
    let sum = 0;
    return bin.map((number, n) => {
      sum += count[n];
      return { x: (number + 1) * width, share: sum / size, sum, size };
    });
  });
  legend(host, recordings.map((one) => one.name));
  chart(host, {
    label: "Cumulative distribution of the latency", height: 280, zoom: "x",
    x: { range, label: "latency [ms]", unit: 1e6 },
    y: { range: [0, 1.02], label: "share of cycles" },
    paint(layer, scale, view, box) {
      shadeSlots(layer, scale, box, slots, true);
      curves.forEach((curve, number) => {
        const steps = [`M${scale.x(range[0])} ${scale.y(0)}`];
        for (const { x, share } of curve) {
          steps.push(`H${scale.x(x).toFixed(1)}V${scale.y(share).toFixed(1)}`);
        }
        steps.push(`H${scale.x(range[1])}`);
        draw(layer, "path", { d: steps.join(""), fill: "none", stroke: colour(number),
          "stroke-width": 1.8 });
      });
    },
    points: (view) => curves.flatMap((curve, number) => curve
      .filter(({ x }) => x >= view.x[0] && x <= view.x[1])
      .map(({ x, share, sum, size }) => ({ x, y: share,
        text: `${recordings[number].name}\n${sum} of ${size} cycles (${(share * 100).toFixed(2)} %)`
          + `\nbelow ${ms(x)} ms` }))).sort((a, b) => a.x - b.x),
  });
  caption(host, "Without cycles that the machine disturbed. Grey: publish slots.");
}

/** Mean communication (pale) and computation (full) of every hop, end to end. */
function plotBreakdown(host, recordings) {
  const shown = recordings.map(({ name, hops }) => ({ name, parts: hops.flatMap((hop, n) =>
    ["communication", "computation"].filter((part) => hop[part]).map((part) =>
      ({ hop: hop.name, n, part, mean: hop[part][0], share: hop[part][1] }))) }));
  const longest = Math.max(1, ...shown.map(({ parts }) => parts.reduce((sum, one) => sum + one.mean, 0)));
  const rows = shown.map(({ parts }, number) => {
    let from = 0;
    return parts.map((one) => ({ ...one, number, from, to: from += one.mean,
      base: shown.length - number - 0.8 }));
  });
  chart(host, {
    label: "Mean communication and computation of every hop", height: 60 + 44 * shown.length,
    x: { range: [0, longest * 1.01], label: "mean, from the start of the cycle [ms]", unit: 1e6 },
    y: { range: [0, shown.length], label: "", bare: true },
    paint(layer, scale) {
      for (const one of rows.flat()) {
        const x = scale.x(one.from), width = scale.x(one.to) - x;
        draw(layer, "rect", { x, y: scale.y(one.base + 0.55), width: Math.max(0.5, width - 1),
          height: scale.y(one.base) - scale.y(one.base + 0.55), fill: colour(one.number),
          opacity: one.part === "communication" ? 0.35 : one.n % 2 ? 0.8 : 1 });
      }
      shown.forEach(({ name }, number) => draw(layer, "text", { class: "label", x: scale.x(0) + 1,
        y: scale.y(shown.length - number - 0.2) }, name));
    },
    points: () => rows.flat().map((one) => ({ x: (one.from + one.to) / 2, y: one.base + 0.3,
      text: `${one.hop}\n${one.part} ${ms(one.mean)} ms, ${(one.share * 100).toFixed(1)} %` })),
  });
  caption(host, "Full: computation, from a callback's start to its publication. Pale: communication, "
    + "from the publication before to the start: transport, and waiting for the executor.");
}

function plotSlots(host, plan) {
  const count = plan.servers.length;
  const slots = plan.servers.flatMap((server, number) => server.slots.map(([start, end]) =>
    ({ server, start, end, base: count - number - 0.85 })));
  chart(host, {
    label: "The servers' slots over one cycle", height: 60 + 40 * count, zoom: "x",
    x: { range: [0, plan.cycle], label: "in the cycle [ms]", unit: 1e6 },
    y: { range: [0, count], label: "", bare: true },
    paint(layer, scale, view, box) {
      for (const { server, start, end, base } of slots) {
        const x = scale.x(start), y = scale.y(base + 0.5);
        draw(layer, "rect", { x, y, width: Math.max(2, scale.x(end) - x),
          height: scale.y(base) - y, rx: 1.5,
          fill: server.output ? "var(--series-1)" : "var(--slot)" });
      }
      plan.servers.forEach(({ name }, number) => draw(layer, "text", { class: "label",
        x: box.left + 2, y: scale.y(count - number - 0.3) }, name));
    },
    points: () => slots.map(({ server, start, end, base }) => ({ x: (start + end) / 2, y: base + 0.25,
      text: `${server.name}\n[${ms(start)}, ${ms(end)}) ms` })),
  });
  caption(host, "Blue: the server in whose slots the output is published. Slots are half-open and "
    + "drawn at least two pixels wide; drag to zoom.");
}
