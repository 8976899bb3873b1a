// The frame of the page: which view is shown, and the event stream of that view.

import { announce, empty, h, mark, say } from "/dom.js";
import { session, signIn } from "/session.js";
import * as programs from "/programs.js";
import * as values from "/values.js";
import * as topic from "/topic.js";
import * as map from "/map.js";
import * as skills from "/skills.js";
import * as processes from "/processes.js";
import * as knowledge from "/knowledge.js";
import * as events from "/events.js";
import * as alarms from "/alarms.js";

const VIEWS = { programs, values, topic, map, skills, processes, knowledge, events, alarms };
const QUIET_MS = 12000;

const main = document.getElementById("main");
const link = document.getElementById("link");

let shown = null;
let stream = null;
let streamQuery = null;
let heard = performance.now();

/** Opens the stream for a query, unless it is open. */
function listen(query) {
  if (query === streamQuery && stream) return;
  stream?.close();
  streamQuery = query;
  stream = new EventSource(`/events?${query}`);
  stream.addEventListener("open", () => { heard = performance.now(); setLink("live"); });
  stream.addEventListener("error", () => setLink("lost"));
  stream.addEventListener("alive", () => { heard = performance.now(); setLink("live"); });
  stream.addEventListener("view", (event) => {
    heard = performance.now();
    setLink("live");
    shown?.update(JSON.parse(event.data));
  });
}

function setLink(state) {
  const texts = { wait: "connecting", live: "live", lost: "reconnecting", quiet: "no data" };
  if (link.dataset.state !== state) {
    link.dataset.state = state;
    say(link, texts[state]);
  }
}

/** Shows the view that the address names. */
function route() {
  const [, name = "programs", ...rest] = location.hash.split("/");
  const view = VIEWS[name] ?? programs;
  shown?.leave?.();
  main.replaceChildren();
  for (const anchor of document.querySelectorAll("#views a")) {
    const own = anchor.getAttribute("href").slice(2);
    const is = own === name || (name === "topic" && own === "values");
    mark(anchor, "aria-current", is ? "page" : null);
    // A phone shows a part of the views.
    if (is) anchor.scrollIntoView({ block: "nearest", inline: "nearest" });
  }
  if (session.mustSignIn) {
    shown = null;
    stream?.close();
    stream = null;
    main.replaceChildren(empty("Sign in", "This page is reached through a proxy: it is shown to signed-in users."));
    setLink("wait");
    return;
  }
  shown = view.show(main, { argument: decodeURIComponent(rest.join("/")), listen, session });
  document.title = `${shown.title} · UA Bridge`;
  listen(shown.query());
  announce(shown.title);
}

window.addEventListener("hashchange", () => {
  if (location.hash === "#main") return;
  route();
  main.focus({ preventScroll: true });
  window.scrollTo(0, 0);
});
document.querySelector(".skip").addEventListener("click", (event) => {
  event.preventDefault();
  main.focus();
});
setInterval(() => {
  if (performance.now() - heard > QUIET_MS && link.dataset.state === "live") setLink("quiet");
  shown?.tick?.();
}, 500);
document.addEventListener("visibilitychange", () => {
  // A hidden page needs no values.
  if (document.hidden) {
    stream?.close();
    stream = null;
  } else if (shown) {
    listen(shown.query());
  }
});

await session.load();
signIn(h, () => (shown && !session.mustSignIn ? shown.signedIn?.() : route()));
route();
