// The knowledge of the MES: queries with their results as table and graph, and files for its sources.

import { announce, badge, count, empty, h, render, say, several } from "/dom.js";
import { draw, text } from "/graph.js";
import { pictures } from "/pictures.js";

const COMMON = "PREFIX css: <http://www.w3id.org/hsu-aut/css#>\nPREFIX rdfs: <http://www.w3.org/2000/01/rdf-schema#>\n";
const EXAMPLES = [
  ["Skills of all components", `${COMMON}SELECT ?component ?name ?state WHERE {
  ?resource css:providesSkill ?skill ; rdfs:label ?component .
  ?skill rdfs:label ?name .
  OPTIONAL { ?skill css:hasCurrentState/rdfs:label ?state }
} ORDER BY ?component ?name LIMIT 100`],
  ["Components, capabilities and skills as a graph", `${COMMON}CONSTRUCT {
  ?resource css:providesSkill ?skill . ?class css:isRealizedBySkill ?skill
} WHERE {
  ?resource css:providesSkill ?skill .
  OPTIONAL { ?capability css:isRealizedBySkill ?skill ; a ?class . ?class rdfs:subClassOf css:Capability }
} LIMIT 100`],
];
/** The competency questions of the plant. */
const MAIN = ["components-of", "state-of", "services-of", "skills-for", "transitions-now", "parameters-of", "outputs-of", "access-of", "modules-with"];
const NO_MES = "Name the address of ua-mes with --status URL: the address of its --sparql, http://127.0.0.1:8087 by default.";

export function show(root, { session }) {
  const summary = h("p", { class: "summary", role: "status" });
  const body = h("div", { class: "runs" });
  root.append(h("div", { class: "head" }, h("h1", { text: "Knowledge" }), summary), body);
  let mes = null;
  let upload = null;
  const load = async () => {
    if (mes === false) {
      render(body, "none", () => [empty("No MES", NO_MES)]);
      return;
    }
    try {
      const response = await fetch("/knowledge/questions");
      const told = await response.json();
      if (!response.ok) throw new Error(told.error);
      const shown = pictures();
      upload = files(session, told, shown.load);
      render(body, "queries", () => [...queries(session, told), shown.node, upload.node]);
      shown.load();
      say(summary, several(told.questions.length, "named question"));
    } catch (error) {
      render(body, error.message, () => [empty("The MES does not answer", error.message)]);
      setTimeout(() => { if (root.isConnected && !upload) load(); }, 3000);
    }
  };
  return {
    title: "Knowledge",
    query: () => "view=knowledge",
    update(data) {
      // A late status does not remove a form in use.
      if (data.mes === mes || data.mes === null || (upload && !data.mes)) return;
      mes = data.mes;
      load();
    },
    signedIn() { upload?.update(); },
  };
}

/** Returns the form of queries, and the place of the result. */
function queries(session, told) {
  const byName = new Map(told.questions.map((question) => [question.name, question]));
  const option = (name) => h("option", { value: name, text: name });
  const others = [...byName.keys()].filter((name) => !MAIN.includes(name));
  const choice = h("select", { id: "question" },
    h("optgroup", { label: "SPARQL" }, EXAMPLES.map(([name], at) => h("option", { value: `example ${at}`, text: name }))),
    h("optgroup", { label: "Questions" }, MAIN.filter((name) => byName.has(name)).map(option)),
    h("optgroup", { label: "Further questions" }, others.map(option)));
  const about = h("p", { class: "muted", id: "question-about" });
  const sparql = h("textarea", { id: "sparql", rows: 9, spellcheck: "false", autocapitalize: "off", "aria-describedby": "query-limits" });
  const free = h("label", {}, h("span", {}, "SPARQL ", h("span", { class: "muted", text: "SELECT, ASK, CONSTRUCT or DESCRIBE; Ctrl and Enter run it" })), sparql);
  const parameters = h("div", { class: "parameters" });
  const fault = h("p", { class: "fault plain-text", role: "alert" });
  const run = h("button", { type: "submit", class: "button", text: "Run" });
  const result = h("section", { class: "card", hidden: true, "aria-labelledby": "result-title" });
  const choose = () => {
    const question = byName.get(choice.value);
    say(about, question ? question.about : "");
    free.hidden = Boolean(question);
    parameters.replaceChildren(...(question?.parameters ?? []).map((name) => h("label", {},
      h("span", {}, name, " ", h("span", { class: "muted", text: "optional" })), h("input", { name, autocomplete: "off", spellcheck: "false" }))));
    if (!question) sparql.value = EXAMPLES[Number(choice.value.split(" ")[1])][1];
  };
  choice.addEventListener("change", choose);
  choose();
  const ask = async (event) => {
    event.preventDefault();
    say(fault, "");
    run.disabled = true;
    const began = performance.now();
    const request = byName.has(choice.value)
      ? { question: choice.value, parameters: Object.fromEntries([...parameters.querySelectorAll("input")].map((input) => [input.name, input.value.trim()])) }
      : { query: sparql.value };
    try {
      const table = await session.post("/knowledge/query", request);
      result.hidden = false;
      result.replaceChildren(...shown(table, (performance.now() - began) / 1000));
      announce(`${several(table.total, "row")} in the result`);
    } catch (error) {
      result.hidden = true;
      say(fault, error.message);
    }
    run.disabled = false;
  };
  const form = h("form", { class: "form query" },
    h("label", {}, h("span", { text: "Question" }), choice), about, parameters, free, fault,
    h("div", { class: "actions" },
      h("p", { class: "muted grow", id: "query-limits", text: `A query ends after 10 s; the first ${count(told.most_rows)} rows are shown.` }), run));
  form.addEventListener("submit", ask);
  sparql.addEventListener("keydown", (event) => {
    if (event.key === "Enter" && (event.ctrlKey || event.metaKey)) form.requestSubmit();
  });
  return [h("section", { class: "card", "aria-labelledby": "query-title" }, h("h2", { id: "query-title", text: "Query" }), form), result];
}

/** Returns the contents of a result: its size, the table, and the graph of statements. */
function shown(table, seconds) {
  const rows = table.rows;
  const hidden = table.total - rows.length;
  const size = `${several(table.total, "row")} in ${seconds.toFixed(1)} s${hidden ? `; the first ${count(rows.length)} are shown` : ""}`;
  const graph = table.columns.length === 3 ? draw(rows) : null;
  return [
    h("h2", { id: "result-title", text: "Result" }),
    h("p", { class: "muted", text: size }),
    rows.length ? h("div", { class: "table-frame", tabindex: 0, role: "region", "aria-label": "Rows" }, h("table", { class: "result" },
      h("thead", {}, h("tr", {}, table.columns.map((name) => h("th", { scope: "col", text: name })))),
      h("tbody", {}, rows.map((row) => h("tr", {}, row.map((cell) => h("td", { title: cell?.is === "uri" ? cell.value : null, text: text(cell) }))))))) : null,
    graph,
  ].filter(Boolean);
}

/** Returns the card for files: chosen, checked, and then loaded. `loaded` is called then. */
function files(session, told, loaded) {
  const largest = told.largest_file;
  const node = h("section", { class: "card", "aria-labelledby": "files-title" });
  const update = () => {
    const title = h("h2", { id: "files-title", text: "Add a source" });
    if (!session.mayLoad) {
      node.replaceChildren(title, h("p", { class: "muted", text: session.maySignIn
        ? "Users with the role engineer load manifests, NodeSets, Turtle and recipes here."
        : "This page has no users: load files with ua-space source add." }));
      return;
    }
    node.replaceChildren(title, form(session, largest, loaded));
  };
  update();
  return { node, update };
}

function form(session, largest, loaded) {
  const limit = `${largest / 2 ** 20} MiB`;
  const input = h("input", { type: "file", id: "file", accept: ".aml,.mtp,.amlx,.ttl,.nt,.xml,.bpmn,.batchml", required: true, "aria-describedby": "file-kinds" });
  const password = h("input", { type: "password", id: "mes-password", autocomplete: "off" });
  const secret = h("label", { hidden: true }, h("span", { text: `Password of ${session.user} in ua-mes` }), password);
  const fault = h("p", { class: "fault plain-text", role: "alert" });
  const found = h("div", { role: "status" });
  const check = h("button", { type: "submit", class: "button quiet", text: "Check" });
  const load = h("button", { type: "button", class: "button", text: "Load", disabled: true });
  const forget = () => { load.disabled = true; found.replaceChildren(); say(fault, ""); };
  input.addEventListener("change", forget);
  const send = async (path) => {
    const file = input.files[0];
    forget();
    if (!file) return;
    if (file.size > largest) {
      say(fault, `${file.name} has more than ${limit}: load it with ua-space source add.`);
      return;
    }
    const headers = { "content-type": "application/octet-stream" };
    if (password.value) headers["x-mes-password"] = btoa(String.fromCharCode(...new TextEncoder().encode(password.value)));
    check.disabled = true;
    try {
      const query = `${path}?name=${encodeURIComponent(file.name)}`;
      const answer = await session.send(query, file, headers, query);
      if (answer.needs_password) {
        const again = Boolean(password.value);
        secret.hidden = false;
        password.value = "";
        password.focus();
        say(fault, again ? `ua-mes refuses ${session.user}: another password there, or not the role engineer.` : "ua-mes has users of its own: enter your password there.");
        return;
      }
      load.disabled = answer.loaded || !answer.accepted;
      found.replaceChildren(...findings(file.name, answer));
      if (answer.loaded) { input.value = ""; password.value = ""; secret.hidden = true; input.focus(); loaded(); } else if (answer.accepted) load.focus();
      announce(answer.loaded ? `${file.name} is loaded` : answer.accepted ? `${file.name} can be loaded` : `${file.name} cannot be loaded`);
    } catch (error) {
      say(fault, error.message);
    } finally {
      check.disabled = false;
    }
  };
  load.addEventListener("click", () => send("/knowledge/load"));
  const made = h("form", { class: "form" },
    h("label", {}, h("span", { text: "File" }), input),
    h("p", { class: "muted", id: "file-kinds", text: `Manifests (.aml, .mtp, .amlx), NodeSets (.xml), Turtle (.ttl, .nt) and recipes (.bpmn, .batchml, .xml), at most ${limit}. A file is checked first.` }),
    secret, fault, found, h("div", { class: "actions" }, check, load));
  made.addEventListener("submit", (event) => { event.preventDefault(); send("/knowledge/check"); });
  return made;
}

/** Returns the outcome of a check, with a row for each finding. */
function findings(name, answer) {
  const verdict = answer.loaded ? ["good", "loaded"] : answer.accepted ? ["run", "can be loaded"] : ["bad", "cannot be loaded"];
  const note = answer.accepted && answer.replaces && !answer.loaded ? " It replaces the source of this name." : "";
  const rows = answer.findings.slice(0, 200);
  return [
    h("p", { class: "plain-text" }, h("strong", { text: name }), " ", badge(...verdict), ` ${several(answer.findings.length, "finding")}.${note}`),
    rows.length ? h("div", { class: "table-frame", tabindex: 0, role: "region", "aria-label": "Findings" }, h("table", { class: "result" },
      h("thead", {}, h("tr", {}, h("th", { scope: "col", class: "number", text: "Line" }), h("th", { scope: "col", text: "Finding" }))),
      h("tbody", {}, rows.map((one) => h("tr", { "data-severity": one.refused ? "bad" : null },
        h("td", { class: "number", text: one.line ?? "–" }), h("td", { text: one.what })))))) : null,
  ].filter(Boolean);
}
