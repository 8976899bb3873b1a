// The conditions of the server: severity, state and message, and their acknowledgement by operators.

import { announce, badge, clock, empty, h, render, say, several } from "/dom.js";

export function show(root, { session }) {
  const summary = h("p", { class: "summary", role: "status" });
  const list = h("ul", { class: "alarms" });
  root.append(h("div", { class: "head" }, h("h1", { text: "Alarms" }), summary), list);
  let last = null;
  const draw = () => {
    const conditions = last?.conditions;
    say(summary, conditions?.length ? `${several(conditions.length, "condition")} · ${last.open ? `${last.open} open` : "none open"}` : "");
    render(list, [conditions, session.user, session.mayOperate], () => rows(conditions, session));
  };
  return {
    title: "Alarms",
    query: () => "view=alarms",
    update(data) { last = data; draw(); },
    signedIn: draw,
  };
}

function rows(conditions, session) {
  if (conditions === undefined) return [];
  if (conditions === null) {
    return [h("li", {}, empty("No server", "Alarms are those of ua-server: its page shows them."))];
  }
  if (!conditions.length) {
    return [h("li", {}, empty("No alarms", "No variable of the mapping has an alarm, and no robot reports diagnostics."))];
  }
  return conditions.map((one) => row(one, session));
}

/** Returns the badges of a condition: its level, and what an operator has to do. */
function states(one) {
  if (!one.is_enabled) return [["none", "disabled"]];
  const level = one.is_active ? [one.severity >= 667 ? "bad" : "uncertain", one.level === "Active" ? "active" : one.level] : ["good", "normal"];
  const open = !one.is_acknowledged ? [["run", "unacknowledged"]] : !one.is_confirmed ? [["run", "unconfirmed"]] : [];
  return [level, ...open];
}

function row(one, session) {
  const all = states(one);
  const note = [one.user, one.comment].filter(Boolean).join(": ");
  const next = !one.is_enabled ? null : !one.is_acknowledged ? "Acknowledge" : !one.is_confirmed ? "Confirm" : null;
  return h("li", { class: "program alarm", "data-severity": all[0][0] },
    h("div", { class: "program-head" },
      h("h2", { text: one.name }),
      all.map(([severity, text]) => badge(severity, text)),
      h("span", { class: "muted grow", text: `severity ${one.severity}` }),
      one.message ? h("span", { class: "muted", text: clock(one.since_ms) }) : null,
      session.mayOperate && next ? h("button", {
        type: "button", class: next === "Acknowledge" ? "button" : "button quiet", text: next,
        "aria-label": `${next} ${one.name}`, onclick: () => ask(one, next, session),
      }) : null),
    one.message ? h("p", { class: "message", text: one.message }) : null,
    note ? h("p", { class: "muted", text: note }) : null);
}

/** Asks for a comment, and acknowledges or confirms the state that was shown. */
function ask(one, action, session) {
  const comment = h("input", { name: "comment", autocomplete: "off", maxlength: 500 });
  const fault = h("p", { class: "fault", role: "alert" });
  const dialog = h("dialog", { "aria-labelledby": "alarm-title" }, h("form", { method: "dialog", class: "form" },
    h("h2", { id: "alarm-title", text: `${action}: ${one.name}` }),
    h("p", { class: "muted", text: one.message }),
    h("label", {}, h("span", {}, "Comment ", h("span", { class: "muted", text: "optional" })), comment), fault,
    h("div", { class: "actions" },
      h("button", { type: "button", class: "button quiet", text: "Cancel", onclick: () => dialog.close() }),
      h("button", { type: "submit", class: "button", text: action }))));
  dialog.querySelector("form").addEventListener("submit", async (event) => {
    event.preventDefault();
    try {
      await session.post("/condition", {
        condition: one.condition, event: one.event, action: action.toLowerCase(), comment: comment.value,
      });
      dialog.close();
      announce(`${one.name}: ${action === "Confirm" ? "confirmed" : "acknowledged"}`);
    } catch (error) {
      say(fault, error.message);
    }
  });
  dialog.addEventListener("close", () => dialog.remove());
  document.body.append(dialog);
  dialog.showModal();
}
