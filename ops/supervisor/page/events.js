// The events of the cell: a strip for each participant over time, live or of a recording.

import { clock, delay, empty, h, render, s, several } from "/dom.js";

const WINDOWS = [["30", "30 seconds"], ["120", "2 minutes"], ["600", "10 minutes"], ["all", "All"]];
const MOST = 2000;
const MOST_ROWS = 60;
const MOST_LISTED = 100;
const LEFT = 200;
const WIDTH = 860;

export function show(root) {
  const summary = h("p", { class: "summary", role: "status" });
  const span = h("select", { "aria-label": "Period" }, WINDOWS.map(([value, text]) => h("option", { value, text })));
  span.value = "120";
  const hold = h("input", { type: "checkbox" });
  // The frames stay, so that a new drawing does not scroll them back.
  const drawing = frame("Participants", "Events over time");
  const list = frame("Last events", "The last events");
  const none = h("div", {});
  root.append(h("div", { class: "head" }, h("h1", { text: "Events" }), summary,
    h("div", { class: "tools" }, span, h("label", { class: "check" }, hold, "Hold"))), none, h("div", { class: "runs" }, drawing.card, list.card));
  let events = [];
  let names = {};
  let state = { recording: null, left_out: 0 };
  /** The clock of the program, ahead of the clock of the browser. */
  let ahead = 0;
  let held = null;
  const now = () => Date.now() + ahead;
  const draw = () => {
    const recording = state.recording;
    const left = state.left_out ? `, ${several(state.left_out, "faster change")} not shown` : "";
    const source = recording ? `recording ${recording}` : "live";
    const told = `${several(events.length, "event")}, ${source}${left}`;
    render(summary, told, () => [told]);
    drawing.card.hidden = list.card.hidden = !events.length;
    if (!events.length) {
      render(none, "none", () => [empty("No events", "An event is the change of a Boolean, an integer, a text or the state of a skill, or a call.")]);
      return;
    }
    render(none, "", () => []);
    const last = Math.max(...events.slice(-50).map((event) => event.ms));
    const end = held ?? (recording ? last + 1000 : Math.max(now(), last));
    const seconds = span.value === "all" ? Infinity : Number(span.value);
    const begin = seconds === Infinity ? events[0].ms : end - seconds * 1000;
    const key = [events.at(-1).id, Math.floor(end / 500), span.value, state, names];
    render(drawing.frame, key, () => strips(events, Math.min(begin, end - 1000), end));
    render(list.frame, [events.at(-1).id, held, names], () => [table(events.filter((event) => event.ms <= end))]);
  };
  hold.addEventListener("change", () => { held = hold.checked ? (state.recording ? null : now()) : null; draw(); });
  span.addEventListener("change", draw);
  return {
    title: "Events",
    query: () => "view=events",
    update(data) {
      if (data.all) events = [];
      if (data.names) names = data.names;
      events.push(...data.events);
      for (const event of events) {
        const [lane, row, world] = names[event.topic] ?? ["others", event.topic, ""];
        Object.assign(event, { lane, row, world });
      }
      // Participants have clocks of their own.
      events.sort((a, b) => a.ms - b.ms || a.id - b.id);
      if (events.length > MOST) events = events.slice(-MOST);
      state = { recording: data.recording, left_out: data.left_out };
      if (data.now_ms) ahead = data.now_ms - Date.now();
      draw();
    },
    tick() { if (!state.recording && events.length) draw(); },
  };
}

/** Creates a card with a title and a frame that scrolls. */
function frame(title, label) {
  const inner = h("div", { class: "table-frame", tabindex: 0, role: "region", "aria-label": label });
  return { frame: inner, card: h("section", { class: "card", hidden: true }, h("h2", { text: title }), inner) };
}

/** Groups the events by participant and by value or call. */
function lanes(events) {
  const all = new Map();
  for (const event of events) {
    const lane = all.get(event.lane) ?? { name: event.lane, worlds: new Set(), rows: new Map() };
    all.set(event.lane, lane);
    lane.worlds.add(event.world);
    const key = `${event.kind === "request" || event.kind === "response" ? "call" : "value"} ${event.row}`;
    const row = lane.rows.get(key) ?? { name: event.row, isCall: key.startsWith("call"), events: [] };
    lane.rows.set(key, row);
    row.events.push(event);
  }
  return [...all.values()].sort((a, b) => a.name.localeCompare(b.name));
}

function strips(events, begin, end) {
  const x = (ms) => LEFT + ((Math.min(Math.max(ms, begin), end) - begin) / (end - begin)) * WIDTH;
  const parts = [];
  let y = 22;
  let rows = 0;
  let hidden = 0;
  for (const lane of lanes(events)) {
    const shown = [...lane.rows.values()].filter((row) => !row.isCall || row.events.some((event) => event.ms >= begin && event.ms <= end));
    const fitting = shown.slice(0, Math.max(0, MOST_ROWS - rows));
    hidden += shown.length - fitting.length;
    if (!fitting.length) continue;
    rows += fitting.length;
    parts.push(
      s("text", { class: "lane", x: 0, y: y + 16, text: lane.name }),
      s("text", { class: "tick", x: LEFT + 5, y: y + 16, text: [...lane.worlds].join(", ") }));
    y += 24;
    for (const row of fitting) {
      parts.push(s("text", { class: "step", x: 0, y: y + 13, text: row.name.length > 28 ? `${row.name.slice(0, 27)}…` : row.name }));
      parts.push(row.isCall ? marks(row, x, y, begin, end) : bars(row, x, y, begin, end));
      y += 22;
    }
    y += 6;
  }
  const ticks = [0, 0.25, 0.5, 0.75, 1].map((part) => [
    s("line", { class: "axis", x1: LEFT + part * WIDTH, x2: LEFT + part * WIDTH, y1: 18, y2: y }),
    s("text", { class: "tick", x: LEFT + part * WIDTH, y: 12, "text-anchor": part === 1 ? "end" : part ? "middle" : "start", text: clock(begin + part * (end - begin)).slice(0, 8) }),
  ]);
  const inside = events.filter((event) => event.ms >= begin && event.ms <= end).length;
  const told = `${several(inside, "event")} from ${clock(begin)} to ${clock(end)}; the table has the last of them`;
  return [
    s("svg", { class: "gantt", viewBox: `0 0 1070 ${y}`, role: "img", "aria-label": told }, ticks, parts),
    hidden ? h("p", { class: "muted", text: `${several(hidden, "more row")} not drawn` }) : null,
  ];
}

/** Draws a bar for each value, from its event to the next. */
function bars(row, x, y, begin, end) {
  const parts = row.events.map((event, at) => ({ event, until: row.events[at + 1]?.ms ?? end }));
  return parts.filter(({ event, until }) => event.ms <= end && until >= begin).map(({ event, until }) => {
    const [from, to] = [x(event.ms), x(until)];
    const width = Math.max(2, to - from);
    const room = Math.floor((width - 8) / 6.6);
    const text = event.text.length > room ? `${event.text.slice(0, Math.max(0, room - 1))}…` : event.text;
    return s("g", { class: "event", "data-severity": event.severity },
      s("title", { text: about(event) }),
      s("rect", { class: "event-bar", x: from, y: y + 1, width, height: 16, rx: 2 }),
      room > 1 ? s("text", { class: "event-text", x: from + 4, y: y + 13, text }) : null);
  });
}

/** Draws a mark for each request and response. */
function marks(row, x, y, begin, end) {
  return row.events.filter((event) => event.ms >= begin && event.ms <= end).map((event) => {
    const at = x(event.ms);
    const shape = event.kind === "request" ? `M${at - 5} ${y + 2}L${at + 5} ${y + 9}L${at - 5} ${y + 16}Z` : `M${at} ${y + 2}L${at + 6} ${y + 9}L${at} ${y + 16}L${at - 6} ${y + 9}Z`;
    return s("g", { class: "event", "data-severity": event.severity },
      s("title", { text: about(event) }), s("path", { class: "step-bar", d: shape }));
  });
}

function about(event) {
  const late = event.delay_us === null ? null : event.delay_us < 0 ? "arrived before its time: the clocks differ" : `arrived after ${delay(event.delay_us)}`;
  return [`${event.lane} ${event.row}: ${event.text}`, clock(event.ms), late].filter(Boolean).join("\n");
}

function table(events) {
  const last = [...events].reverse().slice(0, MOST_LISTED);
  return h("table", { class: "spaces" },
      h("thead", {}, h("tr", {}, ["Time", "Participant", "Value or call", "Event", "Arrived after"].map((text, at) => h("th", { scope: "col", class: at > 3 ? "number" : null, text })))),
      h("tbody", {}, last.map((event) => h("tr", { "data-id": event.id },
        h("td", { text: clock(event.ms) }), h("th", { scope: "row", text: event.lane }), h("td", { text: event.row }),
        h("td", { text: event.text }),
        h("td", { class: "number", text: event.delay_us === null ? "–" : event.delay_us < 0 ? "clocks differ" : delay(event.delay_us) })))));
}
