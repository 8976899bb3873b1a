// The skills as tiles: state, progress, last outcome, and their calls for operators.

import { announce, badge, empty, h, mark, render, say, several } from "/dom.js";

const SEVERITY = { Running: "run", Ready: "good", Halted: "bad", Suspended: "uncertain", "no data": "bad" };

export function show(root, { session }) {
  const summary = h("p", { class: "summary", role: "status" });
  const tiles = h("ul", { class: "tiles" });
  const none = h("div");
  const others = h("section", { class: "card calls", hidden: true });
  root.append(h("div", { class: "head" }, h("h1", { text: "Skills" }), summary), none, tiles, others);
  const made = new Map();
  let last = [];
  let calls = [];
  const draw = () => {
    const running = last.filter((skill) => skill.state === "Running").length;
    say(summary, last.length ? `${several(last.length, "skill")} · ${running} running` : "");
    render(none, [last.length, calls.length], () => last.length || calls.length ? [] : [empty("No skills", "No component of the group publishes the state of a skill.")]);
    const names = last.map((skill) => skill.topic);
    if (names.join() !== [...made.keys()].join()) {
      made.clear();
      last.forEach((skill) => made.set(skill.topic, tile()));
      tiles.replaceChildren(...[...made.values()].map((one) => one.node));
    }
    last.forEach((skill) => made.get(skill.topic).fill(skill, session));
    others.hidden = !calls.length;
    render(others, [calls, session.user, session.mayOperate], () => callList(calls, session));
  };
  return {
    title: "Skills",
    query: () => "view=skills",
    update(data) { last = data.skills; calls = data.calls; draw(); },
    signedIn: draw,
  };
}

function tile() {
  const name = h("h2");
  const component = h("p", { class: "muted" });
  const state = h("span");
  const step = h("p", { class: "step" });
  const bar = h("progress", { max: 1 });
  const outcome = h("p", { class: "outcome" });
  const buttons = h("div", { class: "actions" });
  const node = h("li", { class: "tile" },
    h("div", { class: "tile-head" }, h("div", { class: "grow" }, name, component), state), bar, step, outcome, buttons);
  return {
    node,
    fill(skill, session) {
      say(name, skill.skill);
      say(component, [skill.component, skill.type].filter(Boolean).join(" · "));
      const text = skill.state ?? "unknown";
      const severity = SEVERITY[text] ?? "none";
      mark(node, "data-severity", severity);
      render(state, text, () => [badge(severity, text)]);
      const progress = typeof skill.progress === "number" ? Math.max(0, Math.min(1, skill.progress)) : 0;
      const runs = text === "Running" || text === "Suspended";
      bar.value = runs ? progress : 0;
      mark(bar, "aria-label", `Progress of ${skill.component}.${skill.skill}`);
      say(step, runs ? [`${Math.round(progress * 100)} %`, skill.step].filter(Boolean).join(" · ") : skill.run ? `run ${skill.run}` : "not run yet");
      render(outcome, [skill.result, runs], () => end(skill.result));
      render(buttons, [session.user, session.mayOperate, skill.calls, text], () => session.mayOperate ? actions(skill, session) : []);
    },
  };
}

function end(result) {
  if (!result || result.succeeded === null || result.succeeded === undefined || !result.run) return [];
  const details = Object.entries(result.results ?? {}).map(([name, value]) => `${name} ${rounded(value)}`).join(", ");
  return [
    h("span", { class: result.succeeded ? "done" : "fault", text: result.succeeded ? "Succeeded" : "Failed" }),
    [result.message, details].filter(Boolean).map((text) => `: ${text}`).join(""),
  ];
}

/** Rounds the numbers of a result, which is JSON in a text. */
function rounded(value) {
  return String(value).replace(/-?\d+\.\d{5,}(e-?\d+)?/g, (number) => String(Number(Number(number).toPrecision(5)))).replaceAll(",", ", ");
}

const ALLOWED = {
  Start: ["Ready"], Halt: ["Running", "Suspended", "Ready"], Suspend: ["Running"], Resume: ["Suspended"], Reset: ["Halted"],
};

function actions(skill, session) {
  return Object.entries(skill.calls).filter(([method]) => ALLOWED[method]?.includes(skill.state)).map(([method, call]) => h("button", {
    type: "button",
    class: method === "Halt" ? "button danger" : method === "Start" ? "button" : "button quiet",
    "aria-label": `${method} ${skill.component}.${skill.skill}`,
    onclick: () => begin(`${skill.component}.${skill.skill}.${method}`, method, call, session),
    text: method,
  }));
}

/** Returns the calls of the cell that belong to no skill. */
function callList(calls, session) {
  const fields = (all) => all.map((field) => (field.optional ? `[${field.name}]` : field.name)).join(", ");
  return [
    h("h2", { text: "Calls" }),
    h("ul", { class: "plain" }, calls.map((call) => h("li", { class: "call" },
      h("div", { class: "grow" },
        h("strong", { text: call.name || call.topic }), " ",
        h("span", { class: "muted", text: `(${fields(call.fields)})${call.results.length ? ` → ${call.results.join(", ")}` : ""}` }),
        call.about ? h("p", { class: "muted", text: call.about }) : null),
      session.mayOperate && !call.is_own ? h("button", {
        type: "button", class: "button quiet", text: "Call", "aria-label": `Call ${call.name || call.topic}`,
        onclick: () => begin(call.name || call.topic, "Call", call, session),
      }) : null))),
  ];
}

/** Sends a call at once, or asks for its parameters first. */
function begin(name, verb, call, session) {
  if (call.fields.length) ask(name, verb, call, session);
  else run(name, call, {}, session);
}

/** Shows a text in a dialog. */
function tell(name, kind, lines) {
  const dialog = h("dialog", { "aria-label": name }, h("div", { class: "form" },
    h("h2", { text: name }), lines.map((text) => h("p", { class: kind, role: kind === "fault" ? "alert" : null, text })),
    h("div", { class: "actions" }, h("button", { type: "button", class: "button", text: "Close", onclick: () => dialog.close() }))));
  dialog.addEventListener("close", () => dialog.remove());
  document.body.append(dialog);
  dialog.showModal();
}

/** Shows the response of a call, unless it only confirms. */
function answered(name, answer) {
  announce(`${name} was answered`);
  const all = (answer.response ?? []).filter(([, value]) => value !== null && value !== "");
  // The tile shows the run of a skill.
  const succeeded = all.some(([field, value]) => field === "success" && value === true);
  const fields = all.filter(([field]) => !(succeeded && field === "run"));
  if (fields.some(([, value]) => value !== true)) tell(name, "plain-text", fields.map(([field, value]) => `${field}: ${rounded(JSON.stringify(value))}`));
}

async function run(name, call, fields, session) {
  try {
    answered(name, await session.post("/call", { topic: call.topic, fields }));
  } catch (error) {
    announce(`${name}: ${error.message}`);
    tell(name, "fault", [error.message]);
  }
}

/** Asks for the parameters of a call. */
function ask(name, verb, call, session) {
  const inputs = call.fields.map((field) => {
    const kind = `${field.type}${field.array ? (field.length ? `[${field.length}]` : "[]") : ""}`;
    const input = field.type === "Boolean" && !field.array
      ? h("select", { name: field.name }, field.optional ? h("option", { value: "", text: "default" }) : null, h("option", { value: "false", text: "false" }), h("option", { value: "true", text: "true" }))
      : h("input", { name: field.name, required: !field.optional && field.type !== "String", autocomplete: "off", spellcheck: "false",
        placeholder: field.optional ? "default" : field.array ? "0, 0, 0" : "" });
    return { field, input, label: h("label", {}, h("span", {}, field.name, " ", h("span", { class: "muted", text: field.optional ? `${kind}, optional` : kind })), input) };
  });
  const fault = h("p", { class: "fault", role: "alert" });
  const dialog = h("dialog", { "aria-labelledby": "ask-title" }, h("form", { method: "dialog", class: "form" },
    h("h2", { id: "ask-title", text: name }),
    inputs.map((one) => one.label), fault,
    h("div", { class: "actions" },
      h("button", { type: "button", class: "button quiet", text: "Cancel", onclick: () => dialog.close() }),
      h("button", { type: "submit", class: "button", text: verb }))));
  dialog.querySelector("form").addEventListener("submit", async (event) => {
    event.preventDefault();
    const fields = {};
    for (const { field, input } of inputs) {
      if (input.value !== "" || (!field.optional && field.type === "String")) fields[field.name] = input.value;
    }
    try {
      const answer = await session.post("/call", { topic: call.topic, fields });
      dialog.close();
      answered(name, answer);
    } catch (error) {
      if (dialog.open) say(fault, error.message);
      else tell(name, "fault", [error.message]);
    }
  });
  dialog.addEventListener("close", () => dialog.remove());
  document.body.append(dialog);
  dialog.showModal();
}
