// The programs of the cell: state, reason, and the command that helps.

import { badge, command, count, duration, empty, h, render, several } from "/dom.js";

const STATES = { ready: ["good", "ready"], waiting: ["uncertain", "waiting"], down: ["bad", "not ready"] };

export function show(root) {
  const summary = h("p", { class: "summary", role: "status" });
  const list = h("ul", { class: "programs" });
  const heard = h("section", { class: "heard", hidden: true });
  root.append(h("div", { class: "head" }, h("h1", { text: "Programs" }), summary), list, heard);
  return {
    title: "Programs",
    query: () => "view=programs",
    update(data) {
      const rows = data.programs;
      const down = rows.filter((row) => row.state === "down").length;
      const waiting = rows.filter((row) => row.state === "waiting").length;
      const text = [
        several(rows.length, "program"), down ? `${down} not ready` : "all ready", waiting ? `${waiting} waiting` : "",
        several(data.topics, "topic"), several(data.calls, "call"),
      ].filter(Boolean).join(" · ");
      render(summary, text, () => [text]);
      render(list, rows.map(({ sent, delivered, uptime_s, ...rest }) => rest), () => rows.length
        ? rows.map(row) : [h("li", {}, empty("No program yet", "The status of this program is being read."))]);
      rows.forEach((one, at) => {
        const figures = list.children[at]?.querySelector(".figures");
        if (figures) render(figures, figure(one), () => [figure(one)]);
      });
      heard.hidden = !data.heard.length;
      render(heard, data.heard, () => [
        h("h2", { text: "Also announced in the group" }),
        h("p", { class: "muted" },
          "The state of these programs is not known here. Name the address of their --metrics with --status URL."),
        h("ul", { class: "plain" }, data.heard.map((one) => h("li", {},
          h("strong", { text: one.name || one.uri }), " ",
          h("span", { class: "muted", text: [...(one.urls ?? []), one.from].join(" · ") })))),
      ]);
    },
  };
}

function figure(one) {
  return [
    one.delivered !== undefined ? `${count(one.sent)} sent · ${count(one.delivered)} delivered` : "",
    one.uptime_s ? `up ${duration(one.uptime_s * 1000)}` : "",
  ].filter(Boolean).join(" · ");
}

function row(one) {
  const [severity, text] = STATES[one.state] ?? STATES.down;
  const about = [
    one.space !== undefined && one.space !== null ? `space ${one.space}` : "",
    one.version ? `version ${one.version}` : "",
    one.hash ? `mapping ${one.hash}` : "",
  ].filter(Boolean).join(" · ");
  const problem = (kind) => (each) => h("li", { class: kind },
    h("span", { class: "reason", text: kind === "waits" ? `waiting for ${each.text}` : each.text }),
    command(each.help));
  return h("li", { class: "program", "data-severity": severity },
    h("div", { class: "program-head" },
      h("h2", { text: one.program }),
      badge(severity, text),
      h("span", { class: "muted grow", text: about }),
      h("span", { class: "muted figures" })),
    h("p", { class: "source muted", text: one.source }),
    h("ul", { class: "problems" },
      one.problems.map(problem("down")), one.waiting.map(problem("waits"))));
}
