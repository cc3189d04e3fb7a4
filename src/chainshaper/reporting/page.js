"use strict";
// A small chart: two axes, a view that can be zoomed, points that can be pointed at or walked
// through with the keyboard. Text is only ever set as text, never as markup.

const SVG = "http://www.w3.org/2000/svg";
const tip = document.getElementById("tip");

/** An SVG element with attributes. */
function draw(parent, name, attributes, text) {
  const node = document.createElementNS(SVG, name);
  for (const key in attributes) node.setAttribute(key, attributes[key]);
  if (text !== undefined) node.textContent = text;
  parent.append(node);
  return node;
}

/** An HTML element with properties. */
function make(parent, name, properties, text) {
  const node = document.createElement(name);
  Object.assign(node, properties);
  if (text !== undefined) node.textContent = text;
  parent.append(node);
  return node;
}

/** Nanoseconds as the tables write them. */
const ms = (ns) => (ns / 1e6).toFixed(3);
const colour = (number) => `var(--series-${number % 4})`;

/** Round numbers within [low, high], about so many. */
function ticks(low, high, about) {
  const rough = (high - low) / Math.max(1, about);
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 5, 10].find((factor) => factor * power >= rough);
  const found = [];
  for (let n = Math.ceil(low / step); n * step <= high; n++) found.push(n * step);
  return { at: found, digits: Math.max(0, -Math.floor(Math.log10(step) + 1e-9)) };
}

function showTip(text, x, y) {
  tip.textContent = text;
  tip.hidden = false;
  const box = tip.getBoundingClientRect();
  tip.style.left = `${Math.max(4, Math.min(x + 14, innerWidth - box.width - 4))}px`;
  tip.style.top = `${y + 18 + box.height > innerHeight ? y - box.height - 10 : y + 18}px`;
}
const hideTip = () => { tip.hidden = true; };

function caption(host, text) {
  make(host, "figcaption", {}, text);
}

function legend(host, names) {
  const row = make(host, "div", { className: "legend" });
  names.forEach((name, number) => {
    const item = make(row, "span", {}, name);
    item.style.setProperty("--colour", colour(number));
  });
}

/**
 * A chart in `host`. `spec`: `label`; `height`; `x`, `y`: {range, label, unit (of the axis, in those
 * of the values), bare (no ticks)};
 * `zoom`: "x", "xy" or undefined; `paint(layer, scale, view)` draws, `points(view)` lists what can
 * be pointed at as {x, y, text, go}, in order of x.
 */
function chart(host, spec) {
  const frame = make(host, "div", { className: "chart", tabIndex: 0 });
  frame.setAttribute("role", "group");
  frame.setAttribute("aria-label", spec.label);
  const full = { x: spec.x.range, y: spec.y.range };
  let view = { x: [...full.x], y: [...full.y] };
  let box, svg, marker, focused = -1, dragged = null, points = [], width = 0;
  const scale = {
    x: (value) => box.left + (value - view.x[0]) / (view.x[1] - view.x[0]) * box.width,
    y: (value) => box.top + box.height - (value - view.y[0]) / (view.y[1] - view.y[0]) * box.height,
  };
  const unscale = {
    x: (px) => view.x[0] + (px - box.left) / box.width * (view.x[1] - view.x[0]),
    y: (px) => view.y[0] + (box.top + box.height - px) / box.height * (view.y[1] - view.y[0]),
  };

  function redraw() {
    width = Math.max(280, frame.clientWidth);
    box = { left: 58, top: 10, width: width - 70, height: spec.height - 52 };
    frame.replaceChildren();
    svg = draw(frame, "svg", { viewBox: `0 0 ${width} ${spec.height}` });
    axis("x", spec.x, width / 110);
    axis("y", spec.y, spec.height / 55);
    const clip = `clip-${host.id}`;
    draw(draw(svg, "clipPath", { id: clip }), "rect",
      { x: box.left, y: box.top - 6, width: box.width, height: box.height + 6 });
    spec.paint(draw(svg, "g", { "clip-path": `url(#${clip})` }), scale, view, box);
    marker = draw(svg, "circle", { r: 5, fill: "none", stroke: "var(--ink)", visibility: "hidden" });
    points = spec.points ? spec.points(view) : [];
    focused = -1;
  }

  function axis(which, about, count) {
    const unit = about.unit ?? 1;
    const found = about.bare ? { at: [] }
      : ticks(view[which][0] / unit, view[which][1] / unit, count);
    const group = draw(svg, "g", {});
    for (const value of found.at) {
      const at = scale[which](value * unit), text = value.toFixed(found.digits);
      if (which === "x") {
        draw(group, "line", { class: "grid", x1: at, x2: at, y1: box.top, y2: box.top + box.height });
        draw(group, "text", { x: at, y: box.top + box.height + 16, "text-anchor": "middle" }, text);
      } else {
        draw(group, "line", { class: "grid", x1: box.left, x2: box.left + box.width, y1: at, y2: at });
        draw(group, "text", { x: box.left - 7, y: at + 4, "text-anchor": "end" }, text);
      }
    }
    if (which === "x") {
      draw(group, "line", { class: "axis", x1: box.left, x2: box.left + box.width,
        y1: box.top + box.height, y2: box.top + box.height });
      draw(group, "text", { x: box.left + box.width, y: spec.height - 6, "text-anchor": "end" },
        about.label);
    } else {
      draw(group, "text", { x: 12, y: box.top + box.height / 2, "text-anchor": "middle",
        transform: `rotate(-90 12 ${box.top + box.height / 2})` }, about.label);
    }
  }

  function at(event) {
    const area = svg.getBoundingClientRect(), factor = width / area.width;
    return [(event.clientX - area.left) * factor, (event.clientY - area.top) * factor];
  }

  function point(number) {
    focused = number;
    const one = points[number], area = svg.getBoundingClientRect(), factor = area.width / width;
    const px = scale.x(one.x), py = Math.max(box.top, Math.min(box.top + box.height, scale.y(one.y)));
    marker.setAttribute("cx", px);
    marker.setAttribute("cy", py);
    marker.setAttribute("visibility", "visible");
    showTip(one.text, area.left + px * factor, area.top + py * factor);
  }

  function nearest(px, py) {
    let best = -1, least = 24 ** 2;
    points.forEach((one, number) => {
      const distance = (scale.x(one.x) - px) ** 2
        + (spec.zoom === "x" ? 0 : Math.max(-20, Math.min(20, scale.y(one.y) - py)) ** 2);
      if (distance < least) [best, least] = [number, distance];
    });
    return best;
  }

  function leave() {
    marker.setAttribute("visibility", "hidden");
    hideTip();
  }

  function zoomTo(next) {
    for (const which of spec.zoom) {
      const [low, high] = next[which], [bottom, top] = full[which];
      if (high - low > (top - bottom) * 1e-5) {
        view[which] = [Math.max(bottom, low), Math.min(top, high)];
      }
    }
    redraw();
  }

  function zoomBy(factor) {
    const [low, high] = view.x, middle = points[focused]?.x ?? (low + high) / 2;
    zoomTo({ ...view, x: [middle - (middle - low) * factor, middle + (high - middle) * factor] });
  }

  const reset = () => { view = { x: [...full.x], y: [...full.y] }; redraw(); };

  frame.addEventListener("pointerdown", (event) => {
    if (!spec.zoom || event.button || event.pointerType === "touch") return;
    const [x, y] = at(event);
    dragged = { x, y, rect: draw(svg, "rect", { fill: "var(--slot)", opacity: 0.25 }) };
    frame.setPointerCapture(event.pointerId);
  });
  frame.addEventListener("pointermove", (event) => {
    const [x, y] = at(event);
    if (dragged) {
      const whole = spec.zoom === "x";
      for (const [key, value] of Object.entries({
        x: Math.min(x, dragged.x), width: Math.abs(x - dragged.x),
        y: whole ? box.top : Math.min(y, dragged.y),
        height: whole ? box.height : Math.abs(y - dragged.y),
      })) dragged.rect.setAttribute(key, value);
      return;
    }
    const found = nearest(x, y);
    if (found < 0) leave(); else point(found);
  });
  frame.addEventListener("pointerup", (event) => {
    const begun = dragged, [x, y] = at(event);
    dragged = null;
    if (begun) begun.rect.remove();
    if (begun && Math.abs(x - begun.x) > 6) {
      const across = [unscale.x(begun.x), unscale.x(x)].sort((a, b) => a - b);
      const along = [unscale.y(begun.y), unscale.y(y)].sort((a, b) => a - b);
      zoomTo({ x: across, y: along });
    } else {
      points[nearest(x, y)]?.go?.();
    }
  });
  frame.addEventListener("pointerleave", leave);
  frame.addEventListener("blur", leave);
  frame.addEventListener("dblclick", reset);
  frame.addEventListener("keydown", (event) => {
    const step = { ArrowRight: 1, ArrowLeft: -1, PageDown: 25, PageUp: -25 }[event.key];
    if (step && points.length) {
      point(Math.max(0, Math.min(points.length - 1, focused + step)));
    } else if (event.key === "Enter") points[focused]?.go?.();
    else if (event.key === "+" && spec.zoom) zoomBy(0.5);
    else if (event.key === "-" && spec.zoom) zoomBy(2);
    else if (event.key === "Escape") { reset(); hideTip(); }
    else return;
    event.preventDefault();
  });
  new ResizeObserver(() => { if (Math.abs(frame.clientWidth - width) > 1) redraw(); }).observe(frame);
  redraw();
}
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
// The timeline of one cycle: what ran on which thread, which slots were open, where the machine
// stalled. The chain's own way through it is drawn over everything else.

const ROW = 26, GUTTER = 8;

function plotTimeline(host, recordings) {
  const controls = make(host, "div", { className: "controls" });
  const select = make(controls, "select", { ariaLabel: "recording" });
  recordings.forEach((one) => make(select, "option", {}, one.name));
  const jumps = ["longest", "median", "shortest"].map((name) => {
    const button = make(controls, "button", { type: "button" }, name);
    button.addEventListener("click", () => open(current.chosen[name]));
    return button;
  });
  button("‹", "previous cycle", () => step(-1));
  const number = make(controls, "input", { type: "number", min: 0, ariaLabel: "cycle number" });
  button("›", "next cycle", () => step(1));
  button("+", "zoom in", () => zoom(0.5));
  button("−", "zoom out", () => zoom(2));
  button("whole cycle", "show the whole cycle", () => whole());
  const about = make(host, "p", { className: "about" });
  about.setAttribute("aria-live", "polite");
  const frame = make(host, "div", { className: "chart", tabIndex: 0 });
  frame.setAttribute("role", "group");
  caption(host, "Orange: what the cycle itself ran; pale: transport, and waiting; grey: other "
    + "callbacks; blue: slots; hatched: held by the gate; red: stalls. A callback is pale where its "
    + "end was not recorded. Drag, or the arrow keys, move; "
    + "+ and − or Ctrl with the wheel zoom. " + recordings.map((one) => kept(one)).join(" "));
  const hopTable = make(host, "div", { className: "scroll" });

  let index = 0, current = recordings[0].timeline, cycle, view, dragged = null;

  function button(text, label, action) {
    const node = make(controls, "button", { type: "button", title: label, ariaLabel: label }, text);
    node.addEventListener("click", action);
  }

  function kept({ name, timeline }) {
    if (timeline.cycles.length === timeline.of) return "";
    return `Of ${timeline.of} cycles of ${name} ${timeline.cycles.length} are kept here: the longest, `
      + "the shortest, incomplete ones, those asked for, and a sample of the others.";
  }

  function step(by) {
    const place = current.cycles.indexOf(cycle);
    const next = current.cycles[Math.max(0, Math.min(current.cycles.length - 1, place + by))];
    if (next) open(next.n);
  }

  /** Show the cycle of this number, or the nearest that is kept. */
  function open(wanted) {
    let best;
    for (const one of current.cycles) {
      if (!best || Math.abs(one.n - wanted) < Math.abs(best.n - wanted)) best = one;
    }
    cycle = best;
    if (cycle) whole(wanted);
  }

  function whole(wanted) {
    if (!cycle) return;
    const slots = cycle.origin === undefined ? [] : current.servers.flatMap((one) => one[2]);
    const ends = [cycle.latency ?? 0, cycle.received ?? 0, ...slots.map(([, end]) => end + cycle.origin),
      ...cycle.hops.map((hop) => hop[4] ?? hop[3] ?? hop[2])];
    const length = Math.max(1000, ...ends);
    view = [cycle.start - length * 0.03, cycle.start + length * 1.04];
    number.value = cycle.n;
    const state = cycle.latency === undefined ? `incomplete: ${cycle.reason}` : `${ms(cycle.latency)} ms`;
    const asked = wanted !== undefined && wanted !== cycle.n ? ` (cycle ${wanted} is not kept)` : "";
    about.textContent = `Cycle ${cycle.n}: ${state}${cycle.disturbed ? ", disturbed by the machine" : ""}`
      + `${cycle.received ? `; ${ms(cycle.received)} ms at the subscriber` : ""}`
      + `; began ${(cycle.start / 1e9).toFixed(3)} s after the first${asked}`;
    frame.setAttribute("aria-label", `Timeline. ${about.textContent}. The table below has its figures.`);
    writeHops();
    redraw();
  }

  function writeHops() {
    hopTable.replaceChildren();
    const table = make(hopTable, "table", {});
    const head = make(make(table, "thead", {}), "tr", {});
    ["hop [ms]", "taken", "started", "published", "communication", "computation"].forEach((text) =>
      make(head, "th", { scope: "col" }, text));
    const body = make(table, "tbody", {});
    const shown = (value) => value === null ? "–" : ms(value);
    cycle.hops.forEach(([, take, start, publish], n) => {
      const row = make(body, "tr", {}), before = n ? cycle.hops[n - 1][3] : null;
      make(row, "th", { scope: "row" }, recordings[index].hops[n].name);
      for (const value of [take, start, publish, before === null ? null : start - before,
        publish === null ? null : publish - start]) make(row, "td", {}, shown(value));
    });
  }

  function redraw() {
    frame.replaceChildren();
    if (!cycle) { make(frame, "p", {}, "There is no cycle to show."); return; }
    const width = Math.max(280, frame.clientWidth), narrow = width < 640;
    const left = narrow ? GUTTER : Math.min(230, width * 0.26);
    const scale = (time) => left + (time - view[0]) / (view[1] - view[0]) * (width - left - GUTTER);
    const rows = rowsShown(), height = rows.length * (narrow ? ROW + 14 : ROW) + 40;
    const svg = draw(frame, "svg", { viewBox: `0 0 ${width} ${height}` });
    hatching(svg);
    const clip = draw(draw(svg, "clipPath", { id: "clip-timeline" }), "rect",
      { x: left, y: 0, width: width - left, height });
    clip.parentNode.id = "clip-timeline";
    const bottom = height - 34;
    const found = ticks((view[0] - cycle.start) / 1e6, (view[1] - cycle.start) / 1e6, width / 110);
    for (const value of found.at) {
      const x = scale(cycle.start + value * 1e6);
      draw(svg, "line", { class: "grid", x1: x, x2: x, y1: 0, y2: bottom });
      draw(svg, "text", { x, y: bottom + 15, "text-anchor": "middle" }, value.toFixed(found.digits));
    }
    draw(svg, "text", { x: width - GUTTER, y: height - 4, "text-anchor": "end" },
      "since the cycle's start [ms]");
    const layer = draw(svg, "g", { "clip-path": "url(#clip-timeline)" });
    gaps(layer, scale, bottom);
    rows.forEach((row, n) => {
      const top = n * (narrow ? ROW + 14 : ROW) + (narrow ? 16 : 3);
      row.top = top;
      const label = draw(svg, "text", { class: "label", x: narrow ? GUTTER : left - 10,
        y: narrow ? top - 3 : top + 14, "text-anchor": narrow ? "start" : "end" },
        narrow ? row.name : fitted(row.name, left));
      draw(label, "title", {}, `${row.name} ${row.about}`);
      draw(svg, "line", { class: "grid", x1: left, x2: width, y1: top + ROW - 5, y2: top + ROW - 5 });
      row.paint(layer, scale, top);
    });
    path(layer, scale, rows);
    for (const time of [0, cycle.latency]) {
      if (time === undefined) continue;
      const x = scale(cycle.start + time);
      draw(layer, "line", { x1: x, x2: x, y1: 0, y2: bottom, stroke: "var(--series-0)",
        "stroke-dasharray": "3 3" });
    }
  }

  const fitted = (text, room) => {
    const letters = Math.floor(room / 6.8);
    return text.length > letters ? `…${text.slice(1 - letters)}` : text;
  };

  function hatching(svg) {
    const pattern = draw(svg, "pattern", { id: "held", width: 5, height: 5,
      patternUnits: "userSpaceOnUse", patternTransform: "rotate(45)" });
    draw(pattern, "line", { x1: 0, y1: 0, x2: 0, y2: 5, stroke: "var(--ground)", "stroke-width": 2.5 });
  }

  /** Stretches of time of which this page keeps nothing. */
  function gaps(layer, scale, bottom) {
    let from = -Infinity;
    for (const [began, ended] of [...current.windows, [Infinity, Infinity]]) {
      if (from < view[1] && began > view[0]) {
        const x = scale(Math.max(from, view[0])), end = scale(Math.min(began, view[1]));
        const rect = draw(layer, "rect", { x, y: 0, width: Math.max(0, end - x), height: bottom,
          fill: "var(--panel)" });
        draw(rect, "title", {}, "not kept in this page");
      }
      from = ended;
    }
  }

  function bar(layer, scale, top, start, end, attributes, text, height = 17) {
    const from = Math.max(scale(start), -50), to = Math.min(scale(end), 1e5);
    if (end < view[0] || start > view[1]) return null;
    const rect = draw(layer, "rect", { x: from, y: top + (17 - height) / 2, height,
      width: Math.max(1.5, to - from), rx: 1.5, ...attributes });
    rect.addEventListener("pointermove", (event) => {
      if (dragged) return;
      showTip(text, event.clientX, event.clientY);
      event.stopPropagation();
    });
    return rect;
  }

  function rowsShown() {
    const inView = (start, length) => start + length >= view[0] && start <= view[1];
    const rows = [{ name: "chain", about: "", paint: paintCycles }];
    const own = new Set(cycle.hops.map((hop) => `${hop[0]} ${cycle.start + hop[2]}`));
    current.threads.forEach(([name, about], lane) => rows.push({ name, about, lane,
      paint(layer, scale, top) {
        current.lane.forEach((where, n) => {
          const start = current.start[n], length = current.length[n];
          if (where !== lane || !inView(start, length)) return;
          const mine = own.has(`${lane} ${start}`), used = current.used[n];
          bar(layer, scale, top, start, start + length,
            { fill: mine ? "var(--series-0)" : "var(--idle)", opacity: unended.has(n) ? 0.4 : 1 },
            `${current.callbacks[current.callback[n]]}\n${ms(length)} ms response`
            + `${used === null ? "" : `, ${ms(used)} ms execution`}`
            + `${unended.has(n) ? "\nits end was not recorded" : ""}`);
        });
        for (const one of current.cycles) {
          if (!one.held || one.hops.at(-1)?.[0] !== lane) continue;
          const [arrival, released, overrun] = one.held;
          bar(layer, scale, top, one.start + arrival, one.start + released, { fill: "url(#held)" },
            `cycle ${one.n}: held for ${ms(released - arrival)} ms${overrun ? `, overran: ${overrun}` : ""}`);
        }
      } }));
    for (const [name, about, slots] of current.servers) {
      rows.push({ name: `server ${name}`, about, paint(layer, scale, top) {
        for (const one of current.cycles) {
          if (one.origin === undefined) continue;
          for (const [start, end] of slots) {
            const from = one.start + one.origin;
            bar(layer, scale, top, from + start, from + end,
              { fill: "var(--series-1)", opacity: one === cycle ? 0.9 : 0.35 },
              `server ${name}, cycle ${one.n}\n[${ms(start)}, ${ms(end)}) ms`
              + `${current.assumed ? "\nthe cycle's start is not recorded but assumed" : ""}`);
          }
        }
      } });
    }
    for (const core of new Set(current.stalls.map((stall) => stall[0]))) {
      rows.push({ name: core < 0 ? "stalls" : `stalls of core ${core}`, about: "",
        paint(layer, scale, top) {
          for (const [where, start, length] of current.stalls) {
            if (where !== core || !inView(start, length)) continue;
            bar(layer, scale, top, start, start + length, { fill: "var(--bad)" },
              `the machine stalled for ${ms(length)} ms`, 11);
          }
        } });
    }
    return rows;
  }

  function paintCycles(layer, scale, top) {
    const others = current.cycles.filter((one) => one !== cycle);
    for (const one of [...others, cycle]) {
      if (one.latency === undefined) continue;
      bar(layer, scale, top, one.start, one.start + one.latency,
        { fill: one === cycle ? "var(--series-0)" : "var(--idle)" },
        `cycle ${one.n}\n${ms(one.latency)} ms${one.disturbed ? ", disturbed by the machine" : ""}`, 9);
    }
  }

  /** From each publication to the start of the callback that took the message. */
  function path(layer, scale, rows) {
    const middle = (lane) => rows.find((row) => row.lane === lane).top + 8.5;
    cycle.hops.forEach(([lane, , start, publish, end], n) => {
      if (publish !== null && end !== null && publish > end) { // another callback of the node published for it
        bar(layer, scale, middle(lane) - 8.5, cycle.start + end, cycle.start + publish,
          { fill: "var(--series-0)", opacity: 0.4 },
          `${ms(publish - end)} ms until another callback of the node published`, 5);
      }
      if (!n || cycle.hops[n - 1][3] === null) return;
      const [from, , , sent] = cycle.hops[n - 1];
      const x1 = scale(cycle.start + sent), x2 = scale(cycle.start + start);
      bar(layer, scale, middle(lane) - 8.5, cycle.start + sent, cycle.start + start,
        { fill: "var(--series-0)", opacity: 0.4 },
        `communication ${ms(start - sent)} ms\nto ${recordings[index].hops[n].name}`, 5);
      draw(layer, "path", { d: `M${x1} ${middle(from)}L${x2} ${middle(lane)}`, fill: "none",
        stroke: "var(--ink)", "stroke-width": 1 });
    });
  }

  function zoom(factor, around = (view[0] + view[1]) / 2) {
    const span = (view[1] - view[0]) * factor;
    if (span < 2_000 || span > 20e9) return;
    view = [around - (around - view[0]) * factor, around + (view[1] - around) * factor];
    redraw();
  }

  function move(by) {
    const shift = (view[1] - view[0]) * by;
    view = [view[0] + shift, view[1] + shift];
    redraw();
  }

  let unended = new Set();
  function choose(which) {
    index = which;
    select.selectedIndex = which;
    current = recordings[which].timeline;
    unended = new Set(current.unended);
    number.max = current.of - 1;
    jumps.forEach((jump, n) => {
      jump.disabled = current.chosen[["longest", "median", "shortest"][n]] === undefined;
    });
    cycle = undefined;
  }

  select.addEventListener("change", () => {
    choose(select.selectedIndex);
    open(current.chosen.median ?? 0);
    redraw();
  });
  number.addEventListener("change", () => open(Number(number.value)));
  frame.addEventListener("pointerdown", (event) => {
    if (event.button || !cycle || event.pointerType === "touch") return;
    dragged = { x: event.clientX, view };
    frame.setPointerCapture(event.pointerId);
    hideTip();
  });
  frame.addEventListener("pointermove", (event) => {
    if (!dragged) { hideTip(); return; }
    const shift = (dragged.x - event.clientX) / frame.clientWidth * (dragged.view[1] - dragged.view[0]);
    view = [dragged.view[0] + shift, dragged.view[1] + shift];
    redraw();
  });
  frame.addEventListener("pointerup", () => { dragged = null; });
  frame.addEventListener("pointerleave", hideTip);
  frame.addEventListener("wheel", (event) => {
    if (!event.ctrlKey || !cycle) return;
    event.preventDefault();
    zoom(event.deltaY > 0 ? 1.25 : 0.8);
  }, { passive: false });
  frame.addEventListener("keydown", (event) => {
    const action = { ArrowLeft: () => move(-0.2), ArrowRight: () => move(0.2), "+": () => zoom(0.5),
      "-": () => zoom(2), PageUp: () => step(-1), PageDown: () => step(1), Escape: () => whole() };
    if (!action[event.key] || !cycle) return;
    action[event.key]();
    event.preventDefault();
  });
  let drawn = 0;
  new ResizeObserver(() => {
    if (Math.abs(frame.clientWidth - drawn) > 1) { drawn = frame.clientWidth; redraw(); }
  }).observe(frame);

  choose(recordings.length - 1);
  open(current.chosen.longest ?? 0);
  if (!cycle) redraw();
  return (which, wanted) => {
    if (which !== index) choose(which);
    open(wanted);
    host.scrollIntoView({ behavior: "smooth", block: "nearest" });
    frame.focus({ preventScroll: true });
  };
}
// Draw everything from the data that the page carries.

const report = JSON.parse(document.getElementById("data").textContent);
const place = (id) => {
  const host = document.getElementById(id);
  host.replaceChildren();
  return host;
};
const openCycle = plotTimeline(place("timeline"), report.recordings);
plotOverTime(place("over-time"), report.recordings, openCycle);
plotHistogram(place("histogram"), report.recordings);
plotDistribution(place("cdf"), report.recordings);
plotBreakdown(place("breakdown"), report.recordings);
report.plans.forEach((plan, number) => plotSlots(place(`slots-${number}`), plan));
document.documentElement.dataset.drawn = "yes";
