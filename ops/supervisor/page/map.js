// The map: worlds around the space, with arrows as thick as their rates.

import { count, h, rate, render, s } from "/dom.js";

export function show(root) {
  const summary = h("p", { class: "summary" });
  const drawing = h("div", { class: "map" });
  const table = h("section", { class: "card" });
  root.append(h("div", { class: "head" }, h("h1", { text: "Map" }), summary), drawing, table);
  const delivered = new Map();
  const compact = matchMedia("(max-width: 760px)");
  let last = null;
  const draw = () => { if (last) render(drawing, [last, compact.matches], () => [compact.matches ? tall(last) : wide(last)]); };
  compact.addEventListener("change", draw);
  return {
    title: "Map",
    query: () => "view=map",
    update(data) {
      const now = performance.now();
      last = Object.entries(data.worlds).map(([space, world]) => {
        const before = delivered.get(space);
        const seconds = before ? (now - before.at) / 1000 : 0;
        let into = before?.into ?? 0;
        if (!before || world.delivered !== before.delivered || seconds > 3) {
          if (before && seconds > 0.2) into = Math.max(0, world.delivered - before.delivered) / seconds;
          delivered.set(space, { at: now, delivered: world.delivered, into });
        }
        return { space, ...world, into: Math.round(into * 10) / 10 };
      });
      const total = last.reduce((sum, world) => sum + world.hz, 0);
      render(summary, rate(total), () => [`${rate(total)} values per second cross the space`]);
      draw();
      render(table, last, () => [
        h("h2", { text: "Spaces" }),
        h("div", { class: "table-frame", tabindex: 0, role: "region", "aria-label": "Spaces" }, h("table", { class: "spaces" },
          h("thead", {}, h("tr", {}, ["World", "Space", "Programs", "Topics", "Silent", "Out /s", "In /s", "Dropped"].map((text, at) => h("th", { scope: "col", class: at > 2 ? "number" : null, text })))),
          h("tbody", {}, last.map((world) => h("tr", {},
            h("th", { scope: "row", text: world.label }), h("td", { text: world.space }),
            h("td", { text: world.programs.join(", ") || "–" }),
            [count(world.topics), count(world.silent), rate(world.hz), rate(world.into), count(world.dropped)].map((text) => h("td", { class: "number", text }))))))),
        h("ul", { class: "plain" }, last.flatMap((world) => world.problems.map((text) => h("li", { class: "fault", text })))),
      ]);
    },
    leave() { compact.removeEventListener("change", draw); },
  };
}

function state(world) {
  if (world.problems.length) return "bad";
  if (!world.programs.length && !world.topics) return "none";
  if (world.topics && world.silent === world.topics && !world.programs.length) return "none";
  return world.silent ? "uncertain" : "good";
}

function node(world, x, y, width) {
  const kind = state(world);
  const programs = world.programs.join(", ") || (world.topics ? "programs not watched" : "not present");
  const room = Math.floor(width / 7.4);
  const fit = (text) => (text.length > room ? `${text.slice(0, room - 1)}…` : text);
  return s("g", { class: "world", "data-severity": kind },
    s("title", { text: [world.label, programs, ...world.problems].join("\n") }),
    s("rect", { x, y, width, height: 84, rx: 10 }),
    s("circle", { cx: x + 20, cy: y + 24, r: 5 }),
    s("text", { class: "label", x: x + 34, y: y + 29, text: world.label }),
    s("text", { class: "detail", x: x + 16, y: y + 51, text: fit(programs) }),
    s("text", { class: "detail", x: x + 16, y: y + 70, text: world.topics ? `${count(world.topics)} topics${world.silent ? `, ${count(world.silent)} silent` : ""}` : "no topics" }));
}

function arrow([x1, y1], [x2, y2], hz, kind, [tx, ty]) {
  const width = hz > 0 ? Math.min(9, 1.5 + Math.log2(1 + hz) * 0.9) : 1;
  const length = Math.hypot(x2 - x1, y2 - y1);
  const [ux, uy] = [(x2 - x1) / length, (y2 - y1) / length];
  const head = 6 + width;
  const [bx, by] = [x2 - ux * head, y2 - uy * head];
  const [px, py] = [-uy * head * 0.55, ux * head * 0.55];
  return s("g", { class: "arrow", "data-severity": kind, "data-idle": hz > 0 ? null : "yes" },
    s("line", { x1, y1, x2: bx, y2: by, "stroke-width": width.toFixed(1) }),
    s("path", { d: `M${x2} ${y2}L${bx + px} ${by + py}L${bx - px} ${by - py}Z` }),
    s("text", { x: tx, y: ty, "text-anchor": "middle", text: `${rate(hz)}/s` }));
}

/** Draws the worlds on both sides of the space. */
function wide(worlds) {
  const left = worlds.filter((world) => world.space === "1");
  const right = worlds.filter((world) => world.space !== "1");
  const rows = Math.max(right.length, 2);
  const height = 20 + rows * 124;
  const middle = height / 2;
  const parts = [];
  const place = (list, at) => (list.length === 1 ? middle - 42 : 30 + at * 124 + (rows - list.length) * 62);
  left.forEach((world, at) => {
    const y = place(left, at);
    parts.push(node(world, 20, y, 240));
    parts.push(arrow([262, y + 28], [396, middle - 14], world.hz, state(world), [330, (y + 28 + middle - 14) / 2 - 12]));
    parts.push(arrow([394, middle + 14], [264, y + 56], world.into, state(world), [330, (y + 56 + middle + 14) / 2 + 22]));
  });
  right.forEach((world, at) => {
    const y = place(right, at);
    const [from, to] = [y + 28, y + 56];
    const near = Math.max(60, Math.min(height - 60, middle + (y + 42 - middle) * 0.6));
    parts.push(arrow([738, from], [604, near - 12], world.hz, state(world), [672, (from + near - 12) / 2 - 18]));
    parts.push(arrow([602, near + 12], [738, to], world.into, state(world), [672, (to + near + 12) / 2 + 26]));
    parts.push(node(world, 740, y, 240));
  });
  const tallness = Math.max(150, (rows - 1) * 66 + 110);
  return s("svg", { viewBox: `0 0 1000 ${height}`, role: "img", "aria-label": told(worlds) },
    s("g", { class: "space" },
      s("rect", { x: 400, y: middle - tallness / 2, width: 200, height: tallness, rx: 14 }),
      s("text", { class: "label", x: 500, y: middle - 4, "text-anchor": "middle", text: "Space" }),
      s("text", { class: "detail", x: 500, y: middle + 18, "text-anchor": "middle", text: "OPC UA PubSub (UADP)" })), parts);
}

/** Draws the worlds below the space, for narrow screens. */
function tall(worlds) {
  const parts = worlds.flatMap((world, at) => {
    const y = 116 + at * 150;
    return [
      s("line", { class: "stem", x1: 30, x2: 30, y1: at ? y - 76 : 70, y2: y + 74 }),
      arrow([118, y + 52], [118, y + 8], world.hz, state(world), [78, y + 36]),
      arrow([208, y + 8], [208, y + 52], world.into, state(world), [252, y + 36]),
      node(world, 56, y + 56, 290),
    ];
  });
  return s("svg", { viewBox: `0 0 360 ${130 + worlds.length * 150}`, role: "img", "aria-label": told(worlds) },
    s("g", { class: "space" },
      s("rect", { x: 14, y: 14, width: 332, height: 64, rx: 14 }),
      s("text", { class: "label", x: 180, y: 42, "text-anchor": "middle", text: "Space" }),
      s("text", { class: "detail", x: 180, y: 62, "text-anchor": "middle", text: "OPC UA PubSub (UADP)" })), parts);
}

function told(worlds) {
  return worlds.map((world) => `${world.label}: ${rate(world.hz)} per second out, ${rate(world.into)} in`).join("; ");
}
