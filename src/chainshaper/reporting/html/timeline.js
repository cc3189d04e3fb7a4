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
