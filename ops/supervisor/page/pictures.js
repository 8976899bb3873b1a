// The pictures of modules: those of manifests in the graph of the MES, drawn as SVG.

import { announce, h, s, say, several } from "/dom.js";

/** The elements of a drawing, and the attributes that are taken from it. */
const PARTS = {
  g: ["class"], title: [], text: ["x", "y"], circle: ["cx", "cy", "r"],
  rect: ["class", "x", "y", "width", "height", "rx"], polyline: ["class", "points", "marker-end"],
};
const END = "picture-end";

/** Returns the card of pictures; `load` reads the list. */
export function pictures() {
  const node = h("section", { class: "card", hidden: true, "aria-labelledby": "pictures-title" });
  let chosen = "";
  const load = async () => {
    try {
      const response = await fetch("/knowledge/pictures");
      const told = await response.json();
      if (!response.ok) throw new Error(told.error);
      show(told.pictures);
    } catch (error) {
      title(h("p", { class: "fault plain-text", role: "alert", text: error.message }));
    }
    node.hidden = false;
  };
  const title = (...rest) => node.replaceChildren(h("h2", { id: "pictures-title", text: "Pictures of modules" }), ...rest);
  const show = (all) => {
    if (!all.length) {
      title(h("p", { class: "muted", text: "No manifest in the graph has a picture." }));
      return;
    }
    const modules = new Map();
    for (const one of all) modules.set(one.module, [...(modules.get(one.module) ?? []), one]);
    const choice = h("select", { id: "picture" }, [...modules.values()].map((of) => h("optgroup", { label: of[0].module_name || of[0].module },
      of.map((one) => h("option", { value: one.picture, selected: one.picture === chosen, text: one.name || one.picture })))));
    const fault = h("p", { class: "fault plain-text", role: "alert" });
    const drawing = h("div", {});
    const button = h("button", { type: "submit", class: "button", text: "Show" });
    const form = h("form", { class: "form query" }, h("label", {}, h("span", { text: "Picture" }), choice), fault, h("div", { class: "actions" }, button));
    form.addEventListener("submit", async (event) => {
      event.preventDefault();
      say(fault, "");
      button.disabled = true;
      chosen = choice.value;
      const name = choice.selectedOptions[0].textContent;
      const path = `/knowledge/picture?picture=${encodeURIComponent(chosen)}`;
      try {
        const response = await fetch(path);
        if (!response.ok) throw new Error((await response.json()).error);
        drawing.replaceChildren(...drawn(name, await response.text(), path));
        announce(`The picture ${name} is shown`);
      } catch (error) {
        drawing.replaceChildren();
        say(fault, error.message);
      }
      button.disabled = false;
    });
    title(form, drawing);
  };
  return { node, load };
}

/** Returns the drawing, and a table with the same names. */
function drawn(name, text, path) {
  // The colours are those of the page, whose policy refuses a style in the drawing.
  const source = new DOMParser().parseFromString(text.replace(/<style>[^<]*<\/style>/, ""), "image/svg+xml").documentElement;
  const [width, height] = ["width", "height"].map((length) => Number(source.getAttribute(length)));
  if (source.localName !== "svg" || !(width > 0) || !(height > 0)) throw new Error("The drawing cannot be read.");
  const of = (selector, part) => [...source.querySelectorAll(selector)].map((one) => one.querySelector(part)?.textContent ?? "");
  const names = of("g", "text");
  const rows = of("g", "title").map((about, at) => [names[at], about]);
  const lines = of("polyline", "title");
  const size = `${several(rows.length, "object")}, ${several(lines.length, "connection")}`;
  const picture = s("svg", { class: "module-picture", width, height, viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": `Picture ${name}: ${size}. The table has their names.` },
    s("defs", {}, s("marker", { id: END, viewBox: "0 0 8 8", refX: 8, refY: 4, markerWidth: 8, markerHeight: 8, orient: "auto" }, s("path", { d: "M0 0L8 4L0 8z" }))),
    [...source.children].filter((one) => one.localName !== "title").map(copy));
  return [
    h("figure", { class: "graph-frame" },
      h("div", { class: "table-frame", tabindex: 0, role: "region", "aria-label": `Picture ${name}` }, picture),
      h("figcaption", { class: "muted" }, `${size}. `, h("a", { href: path, download: `${name}.svg`, text: "Save the drawing" }))),
    h("details", {}, h("summary", { text: "Objects and connections" }),
      h("div", { class: "table-frame", tabindex: 0, role: "region", "aria-label": "Objects and connections" }, h("table", { class: "result" },
        h("thead", {}, h("tr", {}, h("th", { scope: "col", text: "Name" }), h("th", { scope: "col", text: "Shows" }))),
        h("tbody", {}, [...rows, ...lines.map((line) => [line, "connection"])].map((row) => h("tr", {}, row.map((cell) => h("td", { text: cell })))))))),
  ];
}

/** Copies an element of a drawing. Elements and attributes that no drawing has are left out. */
function copy(node) {
  const taken = Object.hasOwn(PARTS, node.localName) && PARTS[node.localName];
  if (!taken) return null;
  const attributes = Object.fromEntries(taken.map((name) => [name, node.getAttribute(name)]));
  if (attributes["marker-end"]) attributes["marker-end"] = `url(#${END})`;
  const children = [...node.childNodes].map((child) => (child.nodeType === Node.TEXT_NODE ? child.data : copy(child)));
  return s(node.localName, attributes, children);
}
