// The processes of the MES: each run as a strip of its steps.

import { badge, clock, empty, h, render, s, several } from "/dom.js";

const SEVERITY = { running: "run", done: "good", failed: "bad", lost: "bad", stopped: "uncertain", unknown: "uncertain" };

export function show(root) {
  const summary = h("p", { class: "summary", role: "status" });
  const body = h("div", { class: "runs" });
  // Drawn apart from the runs, so that the focus stays on its buttons.
  const known = h("div", { class: "known" });
  root.append(h("div", { class: "head" }, h("h1", { text: "Processes" }), summary), body, known);
  let last = null;
  const draw = () => {
    if (!last) return;
    if (!last.mes) {
      render(known, "none", () => []);
      render(body, "none", () => [empty("No MES", "Name the address of ua-mes with --status URL: the address of its --sparql, http://127.0.0.1:8087 by default.")]);
      return;
    }
    const runs = [...(last.runs ?? [])].reverse().slice(0, 20);
    const active = runs.some((run) => run.outcome === "running");
    const text = `${several(last.processes.length, "process", "processes")} · ${several(runs.length, "run")}`;
    render(summary, text, () => [text]);
    render(body, [last.runs, active ? Math.floor(Date.now() / 1000) : 0], () => runs.map(strip));
    render(known, last.processes, () => [h("section", { class: "card" }, h("h2", { text: "Known processes" }), h("ul", { class: "plain" }, last.processes.map((process) => {
      const name = process.name || process.process;
      return h("li", { class: "call" },
        h("div", { class: "grow" }, h("strong", { text: name }), " ", h("span", { class: "muted", text: process.steps.join(" → ") })),
        h("button", { type: "button", class: "button quiet", text: "Choices", "aria-label": `Choices of ${name}`, onclick: () => choices(name, process.process) }));
    })))]);
  };
  return { title: "Processes", query: () => "view=processes", update(data) { last = data; draw(); }, tick: draw };
}

function strip(run) {
  const steps = run.plans.flatMap((plan) => plan.ran.map((step) => ({ ...step, plan: plan.number })));
  const begin = run.started_ms;
  const end = run.ended_ms ?? Date.now();
  const span = Math.max(end - begin, 1000);
  const severity = SEVERITY[run.outcome] ?? "none";
  const x = (ms) => 200 + ((Math.min(ms, end) - begin) / span) * 860;
  const name = (step) => (step.step.length > 28 ? `${step.step.slice(0, 27)}…` : step.step);
  const height = 26 + steps.length * 24;
  return h("section", { class: "card run", "data-severity": severity },
    h("div", { class: "tile-head" },
      h("div", { class: "grow" }, h("h2", { text: run.process.split(/[/#:]/).pop() }), h("p", { class: "muted", text: `${clock(begin)} · ${((end - begin) / 1000).toFixed(1)} s · ${several(run.plans.length, "plan")}` })),
      badge(severity, run.outcome)),
    run.reason ? h("p", { class: "fault", text: run.reason }) : null,
    run.waits_for ? h("p", { class: "fault", text: `waits for ${run.waits_for}` }) : null,
    steps.length ? h("div", { class: "table-frame", tabindex: 0, role: "region", "aria-label": "Steps" }, s("svg", { class: "gantt", viewBox: `0 0 1070 ${height}`, role: "img", "aria-label": steps.map((step) => `${step.step}: ${step.outcome}`).join("; ") },
      [0, 0.25, 0.5, 0.75, 1].map((part) => [
        s("line", { class: "axis", x1: 200 + part * 860, x2: 200 + part * 860, y1: 18, y2: height }),
        s("text", { class: "tick", x: 200 + part * 860, y: 12, "text-anchor": part === 1 ? "end" : "middle", text: `${((span * part) / 1000).toFixed(1)} s` }),
      ]),
      steps.map((step, at) => s("g", { "data-severity": SEVERITY[step.outcome] ?? "none" },
        s("title", { text: [step.step, step.component, step.outcome, step.reason].filter(Boolean).join("\n") }),
        s("text", { class: "step", x: 0, y: 37 + at * 24, text: name(step) }),
        s("rect", { class: "step-bar", x: x(step.started_ms), y: 24 + at * 24, rx: 3, height: 17, width: Math.max(3, x(step.ended_ms ?? end) - x(step.started_ms)) }))))) : null);
}

/** Shows the skills that each step would be done by now, with the reason for each choice. */
async function choices(name, process) {
  const body = h("div", { class: "choices", text: "…" });
  const dialog = h("dialog", { class: "wide", "aria-labelledby": "choices-title" }, h("div", { class: "form" },
    h("h2", { id: "choices-title", text: `${name}: choices at present` }), body,
    h("div", { class: "actions" }, h("button", { type: "button", class: "button", text: "Close", onclick: () => dialog.close() }))));
  dialog.addEventListener("close", () => dialog.remove());
  document.body.append(dialog);
  dialog.showModal();
  try {
    const response = await fetch(`/knowledge/plan?process=${encodeURIComponent(process)}`);
    const told = await response.json();
    if (!response.ok) throw new Error(told.error);
    body.replaceChildren(...planned(told));
  } catch (error) {
    body.replaceChildren(h("p", { class: "fault", role: "alert", text: error.message }));
  }
}

/** Returns the steps of a plan with their candidates. */
function planned(told) {
  const rows = told.plan.steps.flatMap((step) => step.needs.flatMap((need) => need.candidates.length
    ? need.candidates.map((one) => ({ step: step.step, who: `${one.component_name} · ${one.name}`, why: one.why, chosen: one.chosen }))
    : [{ step: step.step, who: "no candidate", why: need.capability ?? need.type ?? "", chosen: false }]));
  return [
    told.complete ? badge("good", "complete") : badge("bad", "incomplete"),
    h("div", { class: "table-frame", tabindex: 0, role: "region", "aria-label": "Choices" }, h("table", { class: "result" },
      h("thead", {}, h("tr", {}, ["Step", "Skill", "Choice", "Reason"].map((text) => h("th", { scope: "col", text })))),
      h("tbody", {}, rows.map((row) => h("tr", {}, h("td", { text: row.step }), h("td", { text: row.who }),
        h("td", {}, row.chosen ? badge("good", "chosen") : "–"), h("td", { text: row.why })))))),
  ];
}
