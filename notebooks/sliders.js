// Shows the optimum behind the sliders of each panel; sliders.py has proved them all.
"use strict";
(() => {
  const left = 78, right = 744; // of both charts, in units of the picture
  const sky = { top: 12, bottom: 236 }, lane = { top: 296, bottom: 372 };

  const add = (parent, tag, attributes, text) => {
    const node = document.createElementNS("http://www.w3.org/2000/svg", tag);
    for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
    if (text !== undefined) node.textContent = text;
    return parent.appendChild(node);
  };
  const make = (parent, tag, text) =>
    parent.appendChild(Object.assign(document.createElement(tag), { textContent: text }));

  // Two charts, one above the other: what the schedule does, and which model runs when.
  function axes(svg, panel) {
    const { x, y, names } = panel;
    const scale = (low, high, from, to) => (v) => {
      const within = Math.min(Math.max(v, low), high);
      return +(from + ((to - from) * (within - low)) / (high - low)).toFixed(1);
    };
    const across = scale(x.low, x.high, left, right), up = scale(y.low, y.high, sky.bottom, sky.top);
    const row = scale(0, names.length - 1, lane.bottom, lane.top);
    const text = (px, py, anchor, words, more) =>
      add(svg, "text", { x: px, y: py, "text-anchor": anchor, ...more }, words);
    const rule = (height) => add(svg, "path", { class: "rule", d: `M${left} ${height}H${right}` });
    const upright = (px, py) => ({ transform: `rotate(-90 ${px} ${py})` });
    for (const [value, words] of x.ticks) text(across(value), sky.bottom + 18, "middle", words);
    text((left + right) / 2, sky.bottom + 38, "middle", x.label);
    for (const [value, words] of y.ticks) {
      rule(up(value));
      text(left - 8, up(value) + 5, "end", words);
    }
    const middle = (sky.top + sky.bottom) / 2;
    text(16, middle, "middle", y.label, upright(16, middle));
    names.forEach((name, model) => {
      rule(row(model));
      if (names.length < 5 || model % 2 === 0) text(left - 8, row(model) + 5, "end", name);
    });
    const steps = panel.frames[0].models.length;
    const step = scale(0, steps, left, right);
    for (let k = 0; k <= steps; k += steps / 5) text(step(k), lane.bottom + 22, "middle", k);
    text((left + right) / 2, lane.bottom + 42, "middle", "step");
    return { across, up, row, step };
  }

  const path = (points) => "M" + points.map(([px, py]) => `${px} ${py}`).join("L");

  // What is the same at all positions.
  function still(svg, panel, { across, up }) {
    const along = (values) =>
      values.map((v, t) => [across((panel.x.high * t) / (values.length - 1)), up(v)]);
    const dots = (panel.dots || []).map(([px, py]) => [across(px), up(py)]);
    for (const [px, py] of dots) add(svg, "circle", { class: "dot", cx: px, cy: py, r: 3 });
    for (const [px, py] of panel.diamonds || []) {
      const d = `M${across(px)} ${up(py) - 7}l6 7l-6 7l-6-7Z`;
      add(svg, "path", { class: "diamond", d });
    }
    if (panel.dotted) add(svg, "path", { class: "dotted", d: path(along(panel.dotted)) });
    return along;
  }

  // What belongs to one position.
  function draw(moving, frame, along, { across, up, row, step }) {
    moving.replaceChildren();
    if (frame.band) {
      const [low, high] = frame.band.map(along);
      add(moving, "path", { class: "band", d: path([...low, ...high.reverse()]) + "Z" });
    }
    if (frame.line) add(moving, "path", { class: "line", d: path(along(frame.line)) });
    if (frame.straight) {
      const ends = frame.straight.map(([px, py]) => [across(px), up(py)]);
      add(moving, "path", { class: "straight", d: path(ends) });
    }
    if (frame.at) {
      const [px, py] = frame.at;
      add(moving, "circle", { class: "here", cx: across(px), cy: up(py), r: 8 });
    }
    const stairs = frame.models.map((model, t) => `V${row(model)}H${step(t + 1)}`).join("");
    add(moving, "path", { class: "line stairs", d: `M${left} ${row(frame.models[0])}${stairs}` });
  }

  function tell(output, facts) {
    const list = document.createElement("dl");
    for (const [name, value] of Object.entries(facts)) {
      const pair = list.appendChild(document.createElement("div"));
      make(pair, "dt", name);
      make(pair, "dd", value);
    }
    output.replaceChildren(list);
  }

  function start(root) {
    const panel = JSON.parse(root.querySelector("script").textContent);
    const svg = root.querySelector("svg"), inputs = [...root.querySelectorAll("input")];
    const scales = axes(svg, panel), along = still(svg, panel, scales), moving = add(svg, "g", {});
    const show = () => {
      let place = 0;
      const said = inputs.map((input, k) => {
        const [name, values] = panel.sliders[k];
        place = place * values.length + Number(input.value);
        const value = values[Number(input.value)];
        input.nextElementSibling.textContent = value;
        input.setAttribute("aria-valuetext", value);
        return `${name} ${value}`;
      });
      const frame = panel.frames[place];
      draw(moving, frame, along, scales);
      tell(root.querySelector("output"), frame.facts);
      const runs = `model in use over ${frame.models.length} steps`;
      svg.setAttribute("aria-label", `${panel.y.label} over ${panel.x.label}, and ${runs}, at `
        + `${said.join(", ")}; in numbers below`);
    };
    for (const input of inputs) input.addEventListener("input", show);
    const button = root.querySelector("button"), table = root.querySelector(".table");
    button.addEventListener("click", () => {
      button.setAttribute("aria-expanded", String(table.classList.toggle("open")));
    });
    root.classList.add("live"); // until then, only the table is seen
    show();
  }

  for (const root of document.querySelectorAll(".panel")) start(root);
})();
