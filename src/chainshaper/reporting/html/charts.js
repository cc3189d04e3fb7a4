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
