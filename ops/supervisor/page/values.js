// The values by name: the visible window of the list is all that is sent.

import { age, count, empty, h, mark, rate, rosTopics, s, say, several, sparkline } from "/dom.js";

const HEAD = [
  ["Name", "name"], ["Value", "value"], ["Quality", "quality"], ["Age", "age number"], ["Rate", "rate number"],
  ["Trend", "trend"], ["ROS topic", "ros"], ["Dropped", "drops number"],
];
const EXTRA = 8;

export function show(root, { listen }) {
  let from = 0;
  let total = 0;
  let order = [];
  let wide = 50;
  const rows = new Map();
  const cells = new Map();
  const kept = new URLSearchParams(sessionStorage.getItem("values") ?? "");
  const search = h("input", {
    type: "search", placeholder: "Filter by name or topic", "aria-label": "Filter by name or topic", value: kept.get("filter") ?? "",
  });
  const bad = h("input", { type: "checkbox", id: "only-bad", checked: kept.get("only") === "bad" });
  const summary = h("p", { class: "summary", role: "status" });
  const body = h("tbody");
  const table = h("table", { class: "values" },
    h("caption", { class: "unseen", text: "Values of the cell" }),
    h("thead", {}, h("tr", {}, HEAD.map(([text, kind]) => h("th", { scope: "col", class: kind, text })))), body);
  const none = h("div", { hidden: true });
  root.append(
    h("div", { class: "head" }, h("h1", { text: "Values" }), summary,
      h("div", { class: "tools" }, search,
        h("label", { class: "check", for: "only-bad" }, bad, "Only with problems"))),
    h("div", { class: "table-frame" }, table), none);

  const query = () => {
    const parameters = new URLSearchParams({ view: "values", from, count: wide });
    if (search.value) parameters.set("filter", search.value);
    if (bad.checked) parameters.set("only", "bad");
    return parameters.toString();
  };
  const refresh = () => {
    sessionStorage.setItem("values", new URLSearchParams({ filter: search.value, only: bad.checked ? "bad" : "" }));
    listen(query());
  };
  let timer = null;
  const soon = (wait) => { clearTimeout(timer); timer = setTimeout(refresh, wait); };
  search.addEventListener("input", () => { from = 0; soon(200); });
  bad.addEventListener("change", () => { from = 0; refresh(); });

  // Rows have one height, so the window follows from the position.
  const height = () => (matchMedia("(max-width: 760px)").matches ? 76 : 41);
  const scrolled = () => {
    const top = body.getBoundingClientRect().top;
    const first = Math.max(0, Math.floor(-top / height()) - EXTRA);
    const needed = Math.ceil(innerHeight / height()) + 2 * EXTRA;
    const step = Math.floor(first / EXTRA) * EXTRA;
    if (step !== from || needed > wide) {
      from = Math.min(step, Math.max(0, total - 1));
      wide = Math.min(200, Math.max(needed, 30));
      lay();
      soon(100);
    }
  };
  window.addEventListener("scroll", scrolled, { passive: true });
  window.addEventListener("resize", scrolled);

  function cellsOf(topic) {
    let made = cells.get(topic);
    if (!made) {
      const name = h("a", { href: `#/topic/${topic}` });
      const path = s("path", { class: "line" });
      made = {
        folder: h("span", { class: "folder" }), leaf: h("span"), name,
        value: h("span", { class: "reading" }), unit: h("span", { class: "unit" }),
        quality: h("span", { class: "badge" }), age: h("span"), rate: h("span"), path, ros: h("span"), drops: h("span"),
      };
      name.append(made.folder, made.leaf);
      const drawing = s("svg", { class: "spark", viewBox: "0 0 96 24", width: 96, height: 24, "aria-hidden": "true" }, path);
      const contents = [
        [name], [made.value, " ", made.unit], [made.quality], [made.age], [made.rate], [drawing], [made.ros], [made.drops],
      ];
      made.row = h("tr", {}, HEAD.map(([, kind], at) => h(at ? "td" : "th", at ? { class: kind } : { class: kind, scope: "row" }, contents[at])));
      cells.set(topic, made);
    }
    return made;
  }

  function fill(topic) {
    const data = rows.get(topic);
    const made = cellsOf(topic);
    if (!data) return made.row;
    const at = data.name.lastIndexOf(".");
    say(made.folder, at > 0 ? data.name.slice(0, at + 1) : "");
    say(made.leaf, data.name.slice(at + 1));
    mark(made.name, "title", `${data.name}, ${topic}${data.type ? `, ${data.type}` : ""}`);
    say(made.value, data.value);
    mark(made.value, "title", data.value);
    say(made.unit, data.unit);
    say(made.quality, data.quality);
    mark(made.quality, "data-severity", data.severity);
    mark(made.path, "d", sparkline(data.spark, 96, 24));
    say(made.ros, rosTopics(data.ros));
    mark(made.ros, "title", data.ros.join("\n"));
    const drops = Object.entries(data.drops);
    say(made.drops, drops.length ? count(drops.reduce((sum, [, number]) => sum + number, 0)) : "0");
    mark(made.drops, "title", drops.map(([reason, number]) => `${number} ${reason}`).join("\n"));
    mark(made.drops, "data-some", drops.length ? "yes" : null);
    times(topic);
    return made.row;
  }

  function times(topic) {
    const data = rows.get(topic);
    const made = cells.get(topic);
    if (!data || !made) return;
    const passed = data.age_ms === null ? null : data.age_ms + (performance.now() - data.at);
    say(made.age, age(passed));
    say(made.rate, passed !== null && passed > 6000 ? "0" : rate(data.hz));
  }

  const above = h("tr", { class: "spacer", "aria-hidden": "true" }, h("td", { colspan: HEAD.length }));
  const below = h("tr", { class: "spacer", "aria-hidden": "true" }, h("td", { colspan: HEAD.length }));
  let laid = "";
  function lay() {
    above.firstChild.style.height = `${from * height()}px`;
    below.firstChild.style.height = `${Math.max(0, total - from - order.length) * height()}px`;
    const key = order.join();
    if (key === laid) return;
    laid = key;
    body.replaceChildren(above, ...order.map((topic, at) => {
      const row = fill(topic);
      mark(row, "aria-rowindex", from + at + 2);
      return row;
    }), below);
  }

  return {
    title: "Values",
    query,
    update(data) {
      const now = performance.now();
      for (const [topic, row] of Object.entries(data.rows)) {
        rows.set(topic, { ...row, at: now });
      }
      total = data.total;
      mark(table, "aria-rowcount", total + 1);
      if (data.order) {
        order = data.order;
        from = data.from;
        const keep = new Set(order);
        for (const topic of rows.keys()) {
          if (!keep.has(topic)) { rows.delete(topic); cells.delete(topic); }
        }
        lay();
      }
      for (const topic of Object.keys(data.rows)) fill(topic);
      const text = total === data.topics ? several(total, "topic") : `${count(total)} of ${count(data.topics)} topics`;
      say(summary, data.left_out ? `${text} · ${count(data.left_out)} values without room` : text);
      table.hidden = !total;
      none.hidden = Boolean(total);
      if (!total && !none.firstChild) {
        none.append(empty("No values", "Nothing of the group matches. Bridges publish once a ROS publisher and a mapping, or a topic named ua_<space>_<ns>_<id>, exist."));
      }
    },
    tick() { order.forEach(times); },
    leave() {
      clearTimeout(timer);
      window.removeEventListener("scroll", scrolled);
      window.removeEventListener("resize", scrolled);
    },
  };
}
