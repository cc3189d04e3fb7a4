"use strict";
// Draws the report's charts from the data that the page carries. Text is only ever set as text,
// never as markup. Times are ns; axes show ms or s.

const SVG = "http://www.w3.org/2000/svg", NEAR = 24, tip = document.getElementById("tip");
const pages = JSON.parse(document.getElementById("data").text);

const set = (node, attributes) => {
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  return node;
};
const draw = (parent, name, attributes, text = "") => parent.appendChild(
  set(Object.assign(document.createElementNS(SVG, name), { textContent: text }), attributes));
const make = (parent, name, text) =>
  parent.appendChild(Object.assign(document.createElement(name), { textContent: text }));

const ms = (ns) => (ns / 1e6).toFixed(3);
const OWN = "var(--series-0)", OTHER = "var(--idle)", colour = (number) => `var(--series-${number % 4})`;

/** The next 1, 2 or 5 times a power of ten. */
function rounded(rough) {
  const power = 10 ** Math.floor(Math.log10(rough));
  return power * [1, 2, 5, 10].find((factor) => factor * power >= rough);
}

/**
 * A chart in the figure `id`: two axes, a view that zooms, marks that a pointer or the keyboard finds.
 * `x` and `y` are {range, label, unit (of the axis, in those of the values), bare (no ticks), zero
 * (where ticks count from)}; `zoom` is "x" or "xy"; with `pan` dragging and arrow keys move the view,
 * which zoom and walk through the marks otherwise, and `step(by)` is what page keys do;
 * `paint(pen, view, box)` draws.
 */
function chart(id, spec) {
  const frame = document.querySelector(`#${id} .chart`);
  let view, box, svg, layer, marker, marks = [], focused = -1, drag = null, width = 0;
  const scale = {
    x: (value) => box.left + (value - view.x[0]) / (view.x[1] - view.x[0]) * box.width,
    y: (value) => box.top + box.height - (value - view.y[0]) / (view.y[1] - view.y[0]) * box.height,
  };
  const share = { x: (px) => (px - box.left) / box.width, y: (py) => 1 - (py - box.top) / box.height };
  const value = (which, px) => view[which][0] + share[which](px) * (view[which][1] - view[which][0]);
  const between = (which, ...ends) => ends.map((px) => value(which, px)).sort((a, b) => a - b);
  const pen = {
    ...scale,
    path: (d, attributes) => draw(layer, "path", { d, fill: "none", ...attributes }),
    /** What can be pointed at: `text()` tells about it, `go()` follows it. */
    mark: (x, y, text, go) =>
      marks.push({ x, left: scale.x(x), right: scale.x(x), top: scale.y(y), low: scale.y(y), text, go }),
    bar([from, to], [low, high], attributes, text) {
      if (to < view.x[0] || from > view.x[1]) return;
      const x = Math.max(scale.x(from), -50), y = scale.y(high), height = scale.y(low) - y;
      const length = Math.max(1.5, Math.min(scale.x(to), 1e5) - x);
      draw(layer, "rect", { x, y, width: length, height, rx: 1, ...attributes });
      if (text) marks.push({ x: (from + to) / 2, left: x, right: x + length, top: y, low: y + height, text });
    },
    label: (y, text, about = "") => draw(draw(layer, "text",
      { class: "label", x: box.left + 2, y: scale.y(y) }, text), "title", {}, `${text} ${about}`),
    /** Publish slots, over the whole height or the whole width. */
    shade(slots, vertical) {
      const look = { fill: "var(--slot)", opacity: 0.35, rx: 0 };
      for (const slot of slots) pen.bar(vertical ? slot : view.x, vertical ? view.y : slot, look);
    },
  };

  function redraw() {
    width = Math.max(280, frame.clientWidth);
    box = { left: 58, top: 10, width: width - 70, height: spec.height - 52 };
    frame.replaceChildren();
    svg = draw(frame, "svg", { viewBox: `0 0 ${width} ${spec.height}` });
    axis("x", spec.x, width / 110);
    axis("y", spec.y, spec.height / 55);
    draw(draw(svg, "clipPath", { id: `clip-${id}` }), "rect",
      { x: box.left, y: box.top - 6, width: box.width, height: box.height + 6 });
    layer = draw(svg, "g", { "clip-path": `url(#clip-${id})` });
    [marks, focused] = [[], -1];
    spec.paint(pen, view, box);
    marks.sort((a, b) => a.x - b.x);
    marker = draw(svg, "circle", { r: 5, fill: "none", stroke: "var(--ink)", visibility: "hidden" });
  }

  function axis(which, { unit = 1, zero = 0, bare, label }, about) {
    const [low, high] = view[which].map((value) => (value - zero) / unit), across = which === "x";
    const step = rounded((high - low) / Math.max(1, about)), bottom = box.top + box.height;
    const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9)), middle = box.top + box.height / 2;
    for (let n = Math.ceil(low / step); !bare && n * step <= high; n++) {
      const at = scale[which](n * step * unit + zero), text = (n * step).toFixed(digits);
      draw(svg, "path", { class: "grid", d: across ? `M${at} ${box.top}V${bottom}`
        : `M${box.left} ${at}h${box.width}` });
      draw(svg, "text", across ? { x: at, y: bottom + 16, "text-anchor": "middle" }
        : { x: box.left - 7, y: at + 4, "text-anchor": "end" }, text);
    }
    draw(svg, "text", across
      ? { x: box.left + box.width, y: spec.height - 6, "text-anchor": "end" }
      : { x: 12, y: middle, "text-anchor": "middle", transform: `rotate(-90 12 ${middle})` }, label);
  }

  function at(event) {
    const area = svg.getBoundingClientRect(), factor = width / area.width;
    return [(event.clientX - area.left) * factor, (event.clientY - area.top) * factor];
  }

  function point(number) {
    if (number < 0) return leave();
    focused = number;
    const one = marks[number], area = svg.getBoundingClientRect(), factor = area.width / width;
    const cx = Math.max(box.left, Math.min(box.left + box.width, scale.x(one.x)));
    const cy = Math.max(box.top, Math.min(box.top + box.height, (one.top + one.low) / 2));
    set(marker, { cx, cy, visibility: "visible" });
    tip.textContent = one.text();
    tip.hidden = false;
    const size = tip.getBoundingClientRect(), x = area.left + cx * factor, y = area.top + cy * factor;
    tip.style.left = `${Math.max(4, Math.min(x + 14, innerWidth - size.width - 4))}px`;
    tip.style.top = `${y + 18 + size.height > innerHeight ? y - size.height - 10 : y + 18}px`;
  }

  function nearest(px, py) {
    let best = -1, least = NEAR ** 2;
    marks.forEach(({ left, right, top, low }, number) => {
      const distance = Math.max(left - px, 0, px - right) ** 2
        + Math.min(NEAR - 4, Math.max(top - py, 0, py - low)) ** 2;
      if (distance <= least) [best, least] = [number, distance];
    });
    return best;
  }

  const leave = () => { set(marker, { visibility: "hidden" }); tip.hidden = true; };
  const reset = () => { view = { x: [...spec.x.range], y: [...spec.y.range] }; redraw(); };
  const move = (share, from = view.x) =>
    zoomTo({ ...view, x: from.map((value) => value + share * (from[1] - from[0])) });

  function zoomTo(next) {
    for (const which of spec.zoom) {
      const [low, high] = next[which], [bottom, top] = spec[which].range;
      if (high - low < (top - bottom) * 1e-5) continue;
      view[which] = spec.pan ? [low, high] : [Math.max(bottom, low), Math.min(top, high)];
    }
    redraw();
  }

  function zoomBy(factor, around) {
    const [low, high] = view.x, middle = around ?? marks[focused]?.x ?? (low + high) / 2;
    zoomTo({ ...view, x: [middle - (middle - low) * factor, middle + (high - middle) * factor] });
  }

  frame.addEventListener("pointerdown", (event) => {
    if (!spec.zoom || event.button || event.pointerType === "touch") return;
    const [x, y] = at(event);
    drag = { x, y, from: view.x, rect: draw(svg, "rect", { fill: "var(--slot)", opacity: 0.25 }) };
    frame.setPointerCapture(event.pointerId);
    leave();
  });
  frame.addEventListener("pointermove", (event) => {
    const [x, y] = at(event);
    if (!drag) point(nearest(x, y));
    else if (spec.pan) move((drag.x - x) / box.width, drag.from);
    else {
      const area = spec.zoom === "x" ? { y: box.top, height: box.height }
        : { y: Math.min(y, drag.y), height: Math.abs(y - drag.y) };
      set(drag.rect, { x: Math.min(x, drag.x), width: Math.abs(x - drag.x), ...area });
    }
  });
  frame.addEventListener("pointerup", (event) => {
    const begun = drag, [x, y] = at(event);
    drag = null;
    begun?.rect.remove();
    if (!begun || Math.abs(x - begun.x) <= 6) marks[nearest(x, y)]?.go?.();
    else if (!spec.pan) zoomTo({ x: between("x", begun.x, x), y: between("y", y, begun.y) });
  });
  frame.addEventListener("pointerleave", leave);
  frame.addEventListener("blur", leave);
  frame.addEventListener("dblclick", reset);
  frame.addEventListener("wheel", (event) => {
    if (!event.ctrlKey || !spec.zoom) return;
    event.preventDefault();
    zoomBy(event.deltaY > 0 ? 1.25 : 0.8, value("x", at(event)[0]));
  }, { passive: false });
  frame.addEventListener("keydown", (event) => {
    const step = { ArrowRight: 1, ArrowLeft: -1, PageDown: 25, PageUp: -25 }[event.key];
    const factor = { "+": 0.5, "-": 2 }[event.key];
    if (factor && spec.zoom) zoomBy(factor);
    else if (Math.abs(step) > 1 && spec.step) spec.step(Math.sign(step));
    else if (step && spec.pan) move(step / 5);
    else if (step && marks.length) point(Math.max(0, Math.min(marks.length - 1, focused + step)));
    else if (event.key === "Enter") marks[focused]?.go?.();
    else if (event.key === "Escape") { reset(); leave(); } else return;
    event.preventDefault();
  });
  reset();
  new ResizeObserver(() => { if (Math.abs(frame.clientWidth - width) > 1) redraw(); }).observe(frame);
  return { frame, reset, zoomBy };
}

function plotOverTime({ recordings, publishSlots, longest, range, n }, openCycle) {
  chart(`over-time${n}`, {
    height: 320, zoom: "xy",
    x: { range: [0, longest], label: "since the first cycle [s]", unit: 1e9 },
    y: { range, label: "latency [ms]", unit: 1e6 },
    paint(pen, view, box) {
      pen.shade(publishSlots, false);
      recordings.forEach(({ name, points }, number) => {
        const dots = [], crosses = [], above = [], hits = new Set(points.disturbed);
        points.cycle.forEach((cycle, n) => {
          const time = points.time[n], latency = points.latency[n], hit = hits.has(n);
          if (time < view.x[0] || time > view.x[1] || latency < view.y[0]) return;
          const x = pen.x(time).toFixed(1), y = pen.y(latency).toFixed(1);
          if (latency > view.y[1]) above.push(`M${x} ${box.top - 5}l4 7h-8z`);
          else if (hit) crosses.push(`M${x} ${y}m-3-3l6 6m0-6l-6 6`);
          else dots.push(`M${x} ${y}h0`);
          pen.mark(time, latency, () => `${name}, cycle ${cycle}\n${ms(latency)} ms`
            + `${hit ? ", disturbed by the machine" : ""}\nbegan after ${(time / 1e9).toFixed(3)} s`,
          () => openCycle(number, cycle));
        });
        const stroke = colour(number);
        pen.path(dots.join(""), { stroke, "stroke-width": 3.6, "stroke-linecap": "round" });
        pen.path(crosses.join(""), { stroke, "stroke-width": 1.2 });
        pen.path(above.join(""), { fill: stroke });
        const gaps = points.incomplete.filter((time) => time >= view.x[0] && time <= view.x[1])
          .map((time) => `M${pen.x(time).toFixed(1)} ${box.top + box.height}v-8`);
        pen.path(gaps.join(""), { stroke: "var(--bad)", "stroke-width": 1.5 });
      });
    },
  });
}

/**
 * Fine bins joined to some 80 over a recording's own spread in the view, but none narrower than a
 * pixel. Narrow bands are shown where they are: pixel by pixel.
 */
function joined({ width, bin, count }, [low, high]) {
  const inside = bin.filter((number) => (number + 1) * width > low && number * width < high);
  if (!inside.length) return [];
  const spread = (inside.at(-1) + 1 - inside[0]) * width, pixel = (high - low) / 800;
  const narrow = new Set(inside.map((number) => Math.floor(number * width / pixel))).size < 40;
  const step = Math.max(width, rounded(narrow ? pixel : Math.max(spread / 80, pixel)));
  const sums = new Map();
  bin.forEach((number, n) => {
    const at = Math.floor(number * width / step);
    sums.set(at, (sums.get(at) ?? 0) + count[n]);
  });
  return [...sums].map(([at, total]) => ({ from: at * step, to: (at + 1) * step, total }))
    .filter(({ from, to }) => to > low && from < high);
}

/** One histogram per recording, one above the other, on the same axis of latency. */
function plotHistogram({ recordings, publishSlots, range, n }, rows = recordings.length) {
  chart(`histogram${n}`, {
    height: 70 + 110 * rows, zoom: "x",
    x: { range, label: "latency [ms]", unit: 1e6 },
    y: { range: [0, rows], label: "cycles", bare: true },
    paint(pen, view) {
      pen.shade(publishSlots, true);
      recordings.forEach(({ name, histogram }, number) => {
        const bars = joined(histogram, view.x), base = rows - 1 - number;
        const top = Math.max(1, ...bars.map((bar) => bar.total));
        for (const { from, to, total } of bars) {
          pen.bar([from, to], [base, base + 0.9 * total / top], { fill: colour(number) },
            () => `${name}\n${total} of ${histogram.total} cycles\nin [${ms(from)}, ${ms(to)}) ms`);
        }
        if (bars.length) pen.label(base + 0.82, `highest: ${top}`);
      });
    },
  });
}

function plotDistribution({ recordings, publishSlots, range, n }) {
  chart(`cdf${n}`, {
    height: 280, zoom: "x",
    x: { range, label: "latency [ms]", unit: 1e6 },
    y: { range: [0, 1.02], label: "share of cycles" },
    paint(pen, view) {
      pen.shade(publishSlots, true);
      recordings.forEach(({ name, histogram: { width, bin, count, total } }, number) => {
        const steps = [`M${pen.x(range[0])} ${pen.y(0)}`];
        let sum = 0;
        bin.forEach((at, n) => {
          const x = (at + 1) * width, below = sum += count[n], share = below / total;
          steps.push(`H${pen.x(x).toFixed(1)}V${pen.y(share).toFixed(1)}`);
          if (x >= view.x[0] && x <= view.x[1]) pen.mark(x, share, () => `${name}\n${below} of ${total}`
            + ` cycles (${(share * 100).toFixed(2)} %)\nbelow ${ms(x)} ms`);
        });
        pen.path(`${steps.join("")}H${pen.x(range[1])}`, { stroke: colour(number), "stroke-width": 1.8 });
      });
    },
  });
}

/** Rows of bars [from, to, colour, opacity, text], one below the other, each under its name. */
function plotRows(id, { label, length, zoom, rows }) {
  chart(id, {
    height: 60 + 42 * rows.length, zoom,
    x: { range: [0, length], label: `${label} [ms]`, unit: 1e6 },
    y: { range: [0, rows.length], label: "", bare: true },
    paint: (pen) => rows.forEach(([name, own], number) => {
      const base = rows.length - number - 0.9;
      for (const [from, to, fill, opacity, text] of own) {
        pen.bar([from, to], [base, base + 0.5], { fill: `var(--${fill})`, opacity }, () => text);
      }
      pen.label(base + 0.58, name);
    }),
  });
}

/** The latency of every cycle of a recording as the sum of its hops' parts, hop upon hop. */
function plotStacked({ recordings, opacity, n: suffix }, openCycle) {
  const select = document.querySelector(`#stacked${suffix} select`), parts = Object.keys(opacity);
  let data, sums, drawn;
  const spec = { height: 320, zoom: "xy", paint, x: { label: "cycle" }, y: { label: "latency [ms]", unit: 1e6 } };

  /** Where the cycle drawn n-th ends on the axis: at the next one, where not all are drawn. */
  const end = (n) => data.cycle.length < data.of ? data.cycle[n + 1] ?? data.cycle[n] + 1 : data.cycle[n] + 1;

  function paint(pen, view, box) {
    const inView = [...data.cycle.keys()].filter((n) => end(n) > view.x[0] && data.cycle[n] < view.x[1]);
    const below = data.cycle.map(() => 0), hits = new Set(data.disturbed), above = [];
    for (const hop of data.hops) {
      for (const part of parts) {
        const d = inView.filter((n) => hop[part][n]).map((n) => {
          const low = pen.y(below[n]).toFixed(1), high = pen.y(below[n] += hop[part][n]).toFixed(1);
          return `M${pen.x(data.cycle[n]).toFixed(1)} ${low}V${high}H${pen.x(end(n)).toFixed(1)}V${low}z`;
        }).join("");
        pen.path(d, { fill: colour(hop.series), opacity: opacity[part], "shape-rendering": "crispEdges" });
      }
    }
    for (const n of inView) {
      const middle = (data.cycle[n] + end(n)) / 2;
      if (sums[n] > view.y[1]) above.push(`M${pen.x(middle).toFixed(1)} ${box.top - 5}l4 7h-8z`);
      pen.mark(middle, sums[n], () => `cycle ${data.cycle[n]}: ${ms(sums[n])} ms`
        + (hits.has(n) ? ", disturbed by the machine" : "") + data.hops.map((hop) => `\n${hop.name}: `
        + parts.filter((part) => hop[part][n]).map((part) => `${part} ${ms(hop[part][n])}`).join(", ")).join(""),
      () => openCycle(select.selectedIndex, data.cycle[n]));
    }
    pen.path(above.join(""), { fill: "var(--ink)" });
  }

  function choose() {
    data = recordings[select.selectedIndex].stacked;
    sums = data.cycle.map((_, n) => data.hops.reduce((sum, hop) =>
      parts.reduce((partial, part) => partial + hop[part][n], sum), 0));
    spec.x.range = [data.cycle[0] ?? 0, (data.cycle.at(-1) ?? 0) + 1];
    spec.y.range = [0, data.highest * 1.05];
    return drawn ? drawn.reset() : (drawn = chart(`stacked${suffix}`, spec));
  }

  select.addEventListener("change", choose);
  select.selectedIndex = recordings.length - 1;
  choose();
}

/** Bars of the timeline by kind: cycles, callbacks, those without an end, gated, slots, stalls. */
const FILLS = [OTHER, OTHER, OTHER, "url(#hatched)", "var(--series-1)", "var(--bad)"];

/**
 * What ran on which thread, which slots were open and where the machine stalled, around one cycle;
 * the chain's own way through it is drawn over everything else. What this returns opens a cycle.
 */
function plotTimeline({ recordings, n: suffix }) {
  const host = document.getElementById(`timeline${suffix}`), buttons = [...host.querySelectorAll("button")];
  const [select, number, about, body] = ["select", "input", ".about", "tbody"]
    .map((one) => host.querySelector(one));
  const titles = [...host.querySelectorAll("thead th")].slice(1).map((head) => head.textContent);
  let timeline, cycle, drawn;
  const spec = { zoom: "x", pan: true, paint, step: (by) => step(by),
    x: { label: "since the cycle's start [ms]", unit: 1e6 }, y: { label: "", bare: true } };

  function paint(pen, view, box) {
    if (!cycle) return;
    const { start: zero, hops, latency = 0 } = cycle, base = (row) => timeline.rows.length - row - 0.9;
    const inRow = (row, low, high) => [base(row) + low, base(row) + high];
    for (const gap of timeline.gaps) pen.bar(gap, view.y, { fill: "var(--panel)" }, () => "not in this page");
    const mine = new Set(hops.map(([row, , start]) => `${row} ${zero + start}`));
    timeline.start.forEach((start, n) => {
      const row = timeline.row[n], length = timeline.length[n], used = timeline.used[n];
      const own = timeline.cycle[n] === cycle.n || mine.has(`${row} ${start}`), kind = timeline.kind[n];
      const fill = own && kind < 3 ? OWN : FILLS[kind], opacity = kind === 2 || (kind === 4 && !own) ? 0.4 : 1;
      pen.bar([start, start + length], inRow(row, 0, 0.5), { fill, opacity }, () =>
        `${timeline.texts[timeline.text[n]]}\n${ms(length)} ms`
        + (used === null ? "" : ` response, ${ms(used)} ms execution`));
    });
    hops.forEach(([row, , start, publish, end], n) => {
      const wait = (from, to, text) => pen.bar([zero + from, zero + to], inRow(row, 0.18, 0.32),
        { fill: OWN, opacity: 0.4 }, () => `${text}\n${ms(to - from)} ms`);
      if (publish > (end ?? Infinity)) wait(end, publish, "until another callback of the node published");
      if (!n || hops[n - 1][3] === null) return;
      const [before, , , sent] = hops[n - 1];
      wait(sent, start, "communication");
      pen.path(`M${pen.x(zero + sent)} ${pen.y(base(before) + 0.25)}`
        + `L${pen.x(zero + start)} ${pen.y(base(row) + 0.25)}`, { stroke: "var(--ink)" });
    });
    pen.path([zero, zero + latency].map((time) => `M${pen.x(time)} ${box.top}v${box.height}`).join(""),
      { stroke: OWN, "stroke-dasharray": "3 3" });
    timeline.rows.forEach(([name, detail], row) => pen.label(base(row) + 0.58, name, detail));
  }

  const step = (by) => open(timeline.cycles[timeline.cycles.indexOf(cycle) + by]?.n ?? cycle?.n);

  /** Show the cycle of this number, or the nearest that is in the page. */
  function open(wanted) {
    const far = (one) => Math.abs(one.n - wanted);
    cycle = timeline.cycles.reduce((best, one) => best && far(best) <= far(one) ? best : one, undefined);
    number.value = cycle?.n ?? "";
    about.textContent = "There is no cycle to show.";
    if (!cycle) return drawn?.reset();
    about.textContent = `Cycle ${cycle.n}: ${cycle.about}`
      + `${wanted === cycle.n ? "" : ` (cycle ${wanted} is not in this page)`}`;
    const { start, length } = cycle, rows = timeline.rows.length;
    Object.assign(spec.x, { zero: start, range: [start - 0.03 * length, start + 1.04 * length] });
    [spec.height, spec.y.range] = [60 + 40 * rows, [0, rows]];
    body.replaceChildren(...cycle.hops.map(([, take, start, publish], n) => {
      const row = document.createElement("tr"), sent = n ? cycle.hops[n - 1][3] : null;
      make(row, "th", timeline.hops[n]).scope = "row";
      [take, start, publish, sent === null ? null : start - sent,
        publish === null ? null : publish - start].forEach((time, column) => {
        make(row, "td", time === null ? "–" : ms(time)).dataset.title = titles[column];
      });
      return row;
    }));
    return drawn ? drawn.reset() : (drawn = chart(`timeline${suffix}`, spec));
  }

  function choose(which) {
    select.selectedIndex = which;
    timeline = recordings[which].timeline;
    number.max = timeline.of - 1;
    host.querySelector(".waiting")?.remove();
    for (const one of buttons) one.disabled = !(one.value in actions || one.value in timeline.chosen);
  }

  const actions = { previous: () => step(-1), next: () => step(1), in: () => drawn?.zoomBy(0.5),
    out: () => drawn?.zoomBy(2), whole: () => drawn?.reset() };
  buttons.forEach((one) =>
    one.addEventListener("click", actions[one.value] ?? (() => open(timeline.chosen[one.value]))));
  select.addEventListener("change", () => { choose(select.selectedIndex); open(timeline.chosen.median ?? 0); });
  number.addEventListener("change", () => open(Number(number.value)));
  choose(recordings.length - 1);
  open(timeline.chosen.first ?? timeline.chosen.longest ?? 0);
  return (which, wanted) => {
    if (which !== select.selectedIndex) choose(which);
    open(wanted);
    host.scrollIntoView({ behavior: "smooth", block: "nearest" });
    drawn?.frame.focus({ preventScroll: true });
  };
}

for (const page of pages) {
  const openCycle = plotTimeline(page);
  plotOverTime(page, openCycle);
  plotStacked(page, openCycle);
  for (const plot of [plotHistogram, plotDistribution]) plot(page);
  Object.entries(page.bars).forEach(([id, spec]) => plotRows(id, spec));
}
document.documentElement.dataset.drawn = "yes";
