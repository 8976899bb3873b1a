// A drawing of statements: nodes and arrows, laid out by springs. A table has the same statements.

import { h, s, several } from "/dom.js";

const WIDTH = 900;
const HEIGHT = 520;
const MOST_NODES = 60;
const MOST_LABELS = 40;
const STEPS = 250;
/** The longest ideal length of an arrow; nodes further apart than a multiple of it do not repel each other. */
const LONGEST = 200;
const REACH = 1.6;
const MARGIN = 36;

const PREFIXES = {
  "http://www.w3id.org/hsu-aut/css#": "css:", "http://www.w3id.org/hsu-aut/cask#": "cask:",
  "urn:ua-bridge:plant#": "ua:", "http://www.w3.org/2000/01/rdf-schema#": "rdfs:",
  "http://www.w3.org/1999/02/22-rdf-syntax-ns#": "rdf:", "http://www.w3.org/2002/07/owl#": "owl:",
  "http://www.w3.org/2001/XMLSchema#": "xsd:",
};

/** Returns the text of a cell, with the prefix of a known vocabulary. */
export function text(cell) {
  if (!cell) return "";
  if (cell.is === "bnode") return `_:${cell.value}`;
  if (cell.is !== "uri") return cell.language ? `${cell.value} (${cell.language})` : cell.value;
  for (const [namespace, prefix] of Object.entries(PREFIXES)) {
    if (cell.value.startsWith(namespace)) return prefix + cell.value.slice(namespace.length);
  }
  return cell.value;
}

/** Returns a short name for a drawing. */
function short(cell) {
  const whole = text(cell);
  const name = cell.is === "uri" && whole === cell.value ? whole.split(/[/#]/).filter(Boolean).pop() ?? whole : whole;
  return name.length > 26 ? `…${name.slice(-25)}` : name;
}

/** Returns the nodes and arrows of rows of three cells; the rows that have none are left out. */
function read(rows) {
  const nodes = new Map();
  const arrows = [];
  let left = 0;
  const node = (cell) => {
    const key = `${cell.is} ${cell.value} ${cell.datatype ?? ""} ${cell.language ?? ""}`;
    if (!nodes.has(key) && nodes.size < MOST_NODES) nodes.set(key, { cell, x: 0, y: 0 });
    return nodes.get(key);
  };
  for (const [subject, predicate, object] of rows) {
    const from = subject && node(subject);
    const to = object && node(object);
    if (from && to) arrows.push({ from, to, cell: predicate });
    else left += 1;
  }
  return { nodes: [...nodes.values()], arrows, left };
}

/** Places the nodes: near ones repel each other, and arrows pull their ends together. */
function place(nodes, arrows) {
  const ideal = Math.min(Math.sqrt((WIDTH * HEIGHT) / Math.max(nodes.length, 1)) * 0.75, LONGEST);
  nodes.forEach((node, at) => {
    const angle = (2 * Math.PI * at) / nodes.length;
    node.x = WIDTH / 2 + (WIDTH / 3) * Math.cos(angle);
    node.y = HEIGHT / 2 + (HEIGHT / 3) * Math.sin(angle);
  });
  for (let step = 0; step < STEPS; step += 1) {
    const heat = 40 * (1 - step / STEPS);
    for (const node of nodes) { node.dx = (WIDTH / 2 - node.x) * 0.02; node.dy = (HEIGHT / 2 - node.y) * 0.04; }
    const push = (one, other, force) => {
      const dx = one.x - other.x || 0.1;
      const dy = one.y - other.y || 0.1;
      const far = Math.max(Math.hypot(dx, dy), 1);
      const by = force(far);
      one.dx += (dx / far) * by; one.dy += (dy / far) * by;
      other.dx -= (dx / far) * by; other.dy -= (dy / far) * by;
    };
    nodes.forEach((one, at) => nodes.slice(at + 1).forEach((other) => push(one, other, (far) => (far < ideal * REACH ? (ideal * ideal) / far : 0))));
    for (const { from, to } of arrows) if (from !== to) push(from, to, (far) => (-far * far) / ideal);
    for (const node of nodes) {
      const far = Math.max(Math.hypot(node.dx, node.dy), 1);
      node.x = Math.min(WIDTH - 90, Math.max(90, node.x + (node.dx / far) * Math.min(far, heat)));
      node.y = Math.min(HEIGHT - 24, Math.max(24, node.y + (node.dy / far) * Math.min(far, heat)));
    }
  }
}

/** Moves the nodes to the middle and the top. Returns the height that they need. */
function crop(nodes) {
  const ends = (of) => [Math.min(...nodes.map(of)), Math.max(...nodes.map(of))];
  const [left, right] = ends((node) => node.x);
  const [top, bottom] = ends((node) => node.y);
  for (const node of nodes) {
    node.x += WIDTH / 2 - (left + right) / 2;
    node.y += MARGIN - top;
  }
  return bottom - top + 2 * MARGIN;
}

/** Returns the point of an arrow at the edge of a node of this half width. */
function edge(from, to) {
  const dx = to.x - from.x;
  const dy = to.y - from.y;
  const scale = Math.min(Math.abs((to.half + 4) / (dx || 0.01)), Math.abs(15 / (dy || 0.01)), 1);
  return { x: to.x - dx * scale, y: to.y - dy * scale };
}

/** Returns the drawing of rows of three cells, or null if there is nothing to draw. */
export function draw(rows) {
  const { nodes, arrows, left } = read(rows);
  if (!arrows.length) return null;
  place(nodes, arrows);
  const height = crop(nodes);
  for (const node of nodes) {
    node.label = short(node.cell);
    node.half = Math.max(16, node.label.length * 3.4 + 8);
  }
  const about = `${several(nodes.length, "node")}, ${several(arrows.length, "arrow")}`;
  const named = arrows.length <= MOST_LABELS;
  const picture = s("svg", { class: "graph", viewBox: `0 0 ${WIDTH} ${height.toFixed(0)}`, role: "img", "aria-label": `Graph of the result: ${about}. The table has the same statements.` },
    s("defs", {}, s("marker", { id: "graph-end", viewBox: "0 0 8 8", refX: 7, refY: 4, markerWidth: 7, markerHeight: 7, orient: "auto" },
      s("path", { class: "graph-end", d: "M0 0L8 4L0 8Z" }))),
    arrows.map(({ from, to, cell }) => {
      const end = edge(from, to);
      return s("g", {}, s("title", { text: `${text(from.cell)}\n${text(cell)}\n${text(to.cell)}` }),
        s("line", { class: "graph-arrow", x1: from.x.toFixed(1), y1: from.y.toFixed(1), x2: end.x.toFixed(1), y2: end.y.toFixed(1), "marker-end": "url(#graph-end)" }),
        named && from !== to ? s("text", { class: "graph-name", x: ((from.x + to.x) / 2).toFixed(1), y: ((from.y + to.y) / 2 - 3).toFixed(1), text: short(cell ?? { value: "" }) }) : null);
    }),
    nodes.map((node) => s("g", { class: "graph-node", "data-is": node.cell.is },
      s("title", { text: text(node.cell) }),
      s("rect", { x: (node.x - node.half).toFixed(1), y: (node.y - 12).toFixed(1), width: (node.half * 2).toFixed(1), height: 24, rx: node.cell.is === "literal" ? 3 : 12 }),
      s("text", { x: node.x.toFixed(1), y: (node.y + 4).toFixed(1), text: node.label }))));
  const frame = h("div", { class: "table-frame", tabindex: 0, role: "region", "aria-label": "Graph" }, picture);
  // A narrow window shows the middle first.
  requestAnimationFrame(() => { frame.scrollLeft = (frame.scrollWidth - frame.clientWidth) / 2; });
  return h("figure", { class: "graph-frame" }, frame,
    h("figcaption", { class: "muted", text: left ? `${about}; ${several(left, "row")} in the table only` : about }));
}
