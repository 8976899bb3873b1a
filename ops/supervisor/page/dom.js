// Elements, formats and small drawings that the views share.

const SVG = "http://www.w3.org/2000/svg";

function build(node, attributes, children) {
  for (const [name, value] of Object.entries(attributes ?? {})) {
    if (value === undefined || value === null || value === false) continue;
    if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else if (name === "text") node.textContent = value;
    else node.setAttribute(name, value === true ? "" : value);
  }
  for (const child of children.flat(Infinity)) {
    if (child !== undefined && child !== null && child !== false) node.append(child);
  }
  return node;
}

/** Creates an element. */
export function h(tag, attributes, ...children) {
  return build(document.createElement(tag), attributes, children);
}

/** Creates an element of a drawing. */
export function s(tag, attributes, ...children) {
  return build(document.createElementNS(SVG, tag), attributes, children);
}

/** Sets a text if it differs, so that nothing is laid out anew without need. */
export function say(node, text) {
  const wanted = text ?? "";
  if (node.textContent !== wanted) node.textContent = wanted;
}

/** Sets an attribute if it differs. */
export function mark(node, name, value) {
  if (value === undefined || value === null || value === false) node.removeAttribute(name);
  else if (node.getAttribute(name) !== String(value)) node.setAttribute(name, value);
}

/** Announces a text to screen readers. */
export function announce(text) {
  const node = document.getElementById("said");
  if (node) say(node, text);
}

/** Formats a duration in milliseconds. */
export function duration(ms) {
  if (ms === undefined || ms === null) return "–";
  if (ms < 1000) return `${(ms / 1000).toFixed(2)} s`;
  if (ms < 10000) return `${(ms / 1000).toFixed(1)} s`;
  const seconds = Math.floor(ms / 1000);
  if (seconds < 120) return `${seconds} s`;
  const minutes = Math.floor(seconds / 60);
  if (minutes < 120) return `${minutes} min`;
  const hours = Math.floor(minutes / 60);
  return hours < 48 ? `${hours} h` : `${Math.floor(hours / 24)} d`;
}

/** Formats an age: tenths of seconds up to ten seconds, without jitter below one. */
export function age(ms) {
  if (ms === undefined || ms === null) return "–";
  if (ms < 1000) return "< 1 s";
  return duration(ms);
}

/** Formats a delay in microseconds. */
export function delay(us) {
  if (us === undefined || us === null) return "–";
  if (us < 1000) return `${us < 10 ? us.toFixed(1) : Math.round(us)} µs`;
  if (us < 1e6) return `${(us / 1000).toFixed(us < 1e4 ? 2 : 1)} ms`;
  return `${(us / 1e6).toFixed(2)} s`;
}

/** Formats a rate. */
export function rate(hz) {
  if (!hz) return "0";
  if (hz < 10) return hz.toFixed(1);
  return Math.round(hz).toLocaleString("en");
}

/** Formats a count. */
export function count(number) {
  return (number ?? 0).toLocaleString("en");
}

/** Formats a count with its noun. */
export function several(number, noun, nouns = `${noun}s`) {
  return `${count(number)} ${number === 1 ? noun : nouns}`;
}

/** Formats a time of the day. */
export function clock(ms) {
  const at = new Date(ms);
  const two = (number) => String(number).padStart(2, "0");
  const fraction = String(at.getMilliseconds()).padStart(3, "0");
  return `${two(at.getHours())}:${two(at.getMinutes())}:${two(at.getSeconds())}.${fraction}`;
}

/** Joins the worlds that have a topic of one name: `ROS 1, ROS 2 /odom`. */
export function rosTopics(all) {
  const worlds = new Map();
  for (const text of all) {
    const at = text.lastIndexOf(" /");
    const name = text.slice(at + 1);
    worlds.set(name, [...(worlds.get(name) ?? []), text.slice(0, at)]);
  }
  return [...worlds].map(([name, of]) => `${name} (${of.join(", ")})`).join(", ");
}

/** Returns the path of a sparkline. */
export function sparkline(points, width, height) {
  if (!points || points.length < 2) return "";
  const low = Math.min(...points);
  const span = Math.max(...points) - low;
  const step = width / (points.length - 1);
  const y = (value) => (span > 0 ? height - 2 - ((value - low) / span) * (height - 4) : height / 2);
  return points.map((value, at) => `${at ? "L" : "M"}${(at * step).toFixed(1)} ${y(value).toFixed(1)}`).join("");
}

/** Returns a badge. */
export function badge(severity, text) {
  return h("span", { class: "badge", "data-severity": severity, text });
}

/** Returns a command with a button that copies it. */
export function command(text) {
  const copy = h("button", { class: "copy", type: "button", "aria-label": `Copy: ${text}`, title: "Copy" }, "Copy");
  copy.addEventListener("click", async () => {
    try {
      await navigator.clipboard.writeText(text);
      announce("copied");
      copy.textContent = "Copied";
      setTimeout(() => { copy.textContent = "Copy"; }, 1500);
    } catch {
      copy.textContent = "Select and copy";
    }
  });
  return h("span", { class: "command" }, h("code", { text }), copy);
}

/** Replaces the children of a node, unless `key` is the key of the last call. */
export function render(node, key, children) {
  const text = JSON.stringify(key);
  if (node.shownKey === text) return;
  node.shownKey = text;
  node.replaceChildren(...children().flat(Infinity).filter(Boolean));
}

/** Returns a text for an empty view. */
export function empty(title, text) {
  return h("div", { class: "empty" }, h("p", { class: "empty-title", text: title }), h("p", { text }));
}
