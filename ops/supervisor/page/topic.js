// One topic: its value, its delays, its samples, and why it is missing.

import { badge, clock, count, delay, empty, h, mark, render, rosTopics, s, say } from "/dom.js";

const HOPS = [
  ["out", "local side to the network"],
  ["origin", "in the producer's bridge"],
  ["network", "through the PubSub network"],
  ["in", "network to the local side"],
];

export function show(root, { argument, session }) {
  const topic = argument;
  const title = h("h1", { text: topic });
  const facts = h("p", { class: "summary" });
  const quality = h("span");
  const why = h("section", { class: "card why", hidden: true });
  const value = h("section", { class: "card" });
  const reading = h("div");
  const writing = h("div");
  value.append(reading, writing);
  let last = null;
  const waterfall = h("section", { class: "card" });
  const histogram = h("section", { class: "card" });
  const samples = h("section", { class: "card" });
  const ends = h("section", { class: "card" });
  const none = h("div");
  root.append(
    h("nav", { class: "crumbs", "aria-label": "Path" }, h("a", { href: "#/values", text: "Values" }), " / ", h("span", { text: topic })),
    h("div", { class: "head" }, title, quality, facts), none, why,
    h("div", { class: "grid" }, value, samples, waterfall, histogram, ends));
  return {
    title: topic,
    query: () => new URLSearchParams({ view: "topic", topic }).toString(),
    update(data) {
      drawWhy(why, data.why, data.row?.severity === "good");
      drawWaterfall(waterfall, data.hops);
      if (!data.known) {
        render(none, "none", () => [empty("Unknown topic", `Nothing of ${topic} is known here.`)]);
        return;
      }
      render(none, "", () => []);
      const row = data.row;
      render(title, row.name, () => [row.name]);
      render(quality, [row.severity, row.quality], () => [badge(row.severity, row.quality)]);
      const about = [
        row.name === topic ? "" : topic, `from ${data.origin}`, row.type, rosTopics(row.ros), `${row.hz.toFixed(1)} Hz`,
      ].filter(Boolean).join(" · ");
      render(facts, about, () => [about]);
      last = data;
      drawWrite(writing, data, session);
      render(reading, [data.fields, row.unit, data.about], () => [
        h("h2", { text: "Last value" }),
        data.about ? h("p", { class: "muted", text: data.about }) : null,
        fieldTable(data.fields, row.unit),
      ]);
      render(samples, data.samples, () => [h("h2", { text: "Last samples" }), sampleTable(data.samples)]);
      render(histogram, data.delays, () => drawHistogram(data.delays));
      render(ends, [data.publishers, data.subscribers, data.from], () => drawEnds(data));
    },
    signedIn() { if (last) drawWrite(writing, last, session); },
  };
}

/** Shows the form with which operators write the value. */
function drawWrite(node, { topic, write }, session) {
  render(node, [write, session.user, session.mayOperate], () => {
    if (!write || !session.mayOperate) return [];
    const kind = `${write.type}${write.array ? "[]" : ""}`;
    const input = write.type === "Boolean" && !write.array
      ? h("select", { name: "value" }, h("option", { value: "false", text: "false" }), h("option", { value: "true", text: "true" }))
      : h("input", { name: "value", autocomplete: "off", spellcheck: "false", placeholder: kind, required: write.type !== "String" });
    mark(input, "aria-label", `New value, ${kind}`);
    const result = h("p", { class: "muted", role: "status" });
    const form = h("form", { class: "write" }, input, h("button", { class: "button", type: "submit", text: "Write" }), result);
    form.addEventListener("submit", async (event) => {
      event.preventDefault();
      say(result, "sending");
      mark(result, "class", "muted");
      try {
        await session.post("/write", { topic, value: input.value });
        say(result, "written");
      } catch (error) {
        mark(result, "class", "fault");
        say(result, error.message);
      }
    });
    return [form];
  });
}

function drawWhy(node, reasons, isThere) {
  node.hidden = !reasons.length;
  mark(node, "data-severity", isThere ? "uncertain" : "bad");
  render(node, [reasons, isThere], () => [
    h("h2", { text: isThere ? "Lost samples" : "Why is it not there?" }), h("ul", { class: "plain" }, reasons.map((text) => h("li", { text }))),
  ]);
}

function text(value) {
  if (value === null) return "–";
  if (Array.isArray(value)) return value.map(text).join("  ");
  if (typeof value === "object") return value.ms !== undefined ? clock(value.ms) : JSON.stringify(value);
  if (typeof value === "number" && !Number.isInteger(value)) return String(Number(value.toPrecision(7)));
  return String(value);
}

function fieldTable(fields, unit) {
  const all = fields;
  if (!all.length) return h("p", { class: "muted", text: "No value was received." });
  return h("table", { class: "fields" }, h("tbody", {}, all.map(([name, value]) => h("tr", {},
    h("th", { scope: "row", text: name }),
    h("td", {}, h("span", { class: "reading", text: text(value) }), all.length === 1 && unit ? h("span", { class: "unit", text: ` ${unit}` }) : null)))));
}

function sampleTable(samples) {
  if (!samples.length) return h("p", { class: "muted", text: "Samples are shown from now on." });
  return h("table", { class: "samples" },
    h("thead", {}, h("tr", {}, ["Time", "Delay", "Value"].map((name) => h("th", { scope: "col", text: name })))),
    h("tbody", {}, samples.slice(0, 12).map((sample) => h("tr", { "data-severity": sample.severity },
      h("td", { class: "number", text: clock(sample.ms) }), h("td", { class: "number", text: delay(sample.delay_us) }),
      h("td", { class: "reading", text: sample.value })))));
}

function drawWaterfall(node, programs) {
  const isHere = programs.some(({ hops, of_topic: isOfTopic }) => isOfTopic && hops.out?.count);
  // In the order of the way. The producer's bridge and its readers measure the same time.
  const bars = HOPS.flatMap(([name, label]) => programs
    .filter(({ hops }) => hops[name]?.count && !(isHere && name === "origin"))
    .map(({ program, space, hops, of_topic: isOfTopic }) => ({ program, space, label, isOfTopic, ...hops[name] })));
  render(node, bars, () => {
    const head = [h("h2", { text: "Hops" }), h("p", { class: "muted", text: "Half of the samples are within the dark bar, 99 % within the light bar." })];
    if (!bars.length) return [...head, h("p", { class: "muted", text: "No delays were measured yet." })];
    const most = Math.max(...bars.map((bar) => bar.p99_us), 1);
    return [...head, h("table", { class: "hops" },
      h("thead", {}, h("tr", {}, ["Hop", "Bar", "p50", "p99", "max"].map((name) => h("th", { scope: "col" }, h("span", { class: name === "Bar" ? "unseen" : null, text: name }))))),
      h("tbody", {}, bars.map((bar) => h("tr", {},
        h("th", { scope: "row" }, h("span", { text: bar.label }), h("span", { class: "muted block", text: `${bar.program}, ${count(bar.count)} samples${bar.isOfTopic ? "" : " of all its topics"}` })),
        h("td", { class: "bars" }, s("svg", { viewBox: "0 0 100 14", preserveAspectRatio: "none", "aria-hidden": "true" },
          s("rect", { class: "far", x: 0, y: 2, width: Math.max(0.8, (bar.p99_us / most) * 100), height: 10, rx: 1 }),
          s("rect", { class: "near", x: 0, y: 2, width: Math.max(0.8, (bar.p50_us / most) * 100), height: 10, rx: 1 }))),
        [bar.p50_us, bar.p99_us, bar.max_us].map((us) => h("td", { class: "number", text: delay(us) }))))))];
  });
}

function drawHistogram({ classes, negative, last_us }) {
  const head = [h("h2", { text: "Delay to this program" }), h("p", { class: "muted", text: `Last ${delay(last_us)}${negative ? ` · ${count(negative)} negative: the clocks of the hosts differ` : ""}` })];
  const first = classes.findIndex((number) => number);
  if (first < 0) return [...head, h("p", { class: "muted", text: "No delays were measured yet." })];
  const last = classes.findLastIndex((number) => number);
  const low = Math.max(0, Math.min(first, 4) === first ? first - 1 : first - 1);
  const shown = classes.slice(low, Math.max(last + 2, low + 6));
  const most = Math.max(...shown);
  const total = shown.reduce((sum, number) => sum + number, 0);
  const width = 420 / shown.length;
  const label = (at) => delay(2 ** (low + at)).replace(/\.0+ /, " ").replace(/(\d)\.\d+ (ms|s)/, "$1 $2");
  const every = shown.length > 9 ? 2 : 1;
  return [...head, s("svg", { class: "histogram", viewBox: "0 0 420 168", role: "img", "aria-label": `${count(total)} delays, most near ${label(shown.indexOf(most))}` },
    s("line", { class: "axis", x1: 0, x2: 420, y1: 140, y2: 140 }),
    shown.map((number, at) => [
      number ? s("rect", { class: "near", x: at * width + 2, width: width - 4, y: 140 - Math.max(2, (number / most) * 118), height: Math.max(2, (number / most) * 118), rx: 2 }, s("title", { text: `${count(number)} samples from ${label(at)}` })) : null,
      number ? s("text", { class: "figure", x: at * width + width / 2, y: 134 - Math.max(2, (number / most) * 118), text: `${Math.round((number / total) * 100)} %` }) : null,
      at % every ? null : s("text", { class: "tick", x: at * width + 2, y: 158, text: label(at) }),
    ]))];
}

function drawEnds({ publishers, subscribers, from }) {
  const list = (all, figure) => all.length
    ? h("ul", { class: "plain" }, all.map((one) => h("li", {}, h("strong", { text: one.program }), " ",
      h("span", { class: "muted", text: figure(one) }))))
    : h("p", { class: "muted", text: "None is known." });
  const drops = (one) => Object.entries(one.dropped).map(([reason, number]) => `${count(number)} dropped: ${reason}`);
  return [
    h("h2", { text: "Publishers" }),
    list(publishers, (one) => [`space ${one.space}`, `${count(one.sent)} sent`, ...drops(one)].join(" · ")),
    from ? h("p", { class: "muted", text: `announced from ${from}` }) : null,
    h("h2", { text: "Subscribers" }),
    list(subscribers, (one) => [`space ${one.space}`, `${count(one.delivered)} delivered`, ...drops(one)].join(" · ")),
  ];
}
