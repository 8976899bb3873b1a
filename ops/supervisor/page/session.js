// The session of the user, and requests that change something.

import { announce, say } from "/dom.js";

/** The session as the server describes it. */
export const session = {
  user: null,
  roles: "",
  csrf: "",
  mayOperate: false,
  mayLoad: false,
  maySignIn: false,
  mustSignIn: false,
  pending: new Set(),

  /** Reads the session. */
  async load() {
    const response = await fetch("/session");
    if (!response.ok) return;
    this.take(await response.json());
  },

  take(told) {
    this.user = told.user ?? null;
    this.roles = told.roles ?? "";
    this.csrf = told.csrf ?? "";
    this.mayOperate = Boolean(told.may_operate);
    this.mayLoad = Boolean(told.may_load);
    this.maySignIn = Boolean(told.may_sign_in);
    this.mustSignIn = Boolean(told.must_sign_in);
    const user = document.getElementById("user");
    say(user, this.user ? `${this.user} (${this.roles})` : "");
    const sign = document.getElementById("sign");
    sign.hidden = !this.maySignIn;
    say(sign, this.user ? "Sign out" : "Sign in");
  },

  /**
   * Sends a request that changes something. Returns the response, or throws the reason. A request
   * is not sent again before its response has come.
   */
  async post(path, body) {
    const text = JSON.stringify(body);
    return this.send(path, text, { "content-type": "application/json" }, `${path} ${text}`);
  },

  /** Sends a body of another type, such as a file. `sent` names the request. */
  async send(path, body, headers, sent) {
    if (this.pending.has(sent)) throw new Error("already sent: its outcome is awaited");
    this.pending.add(sent);
    try {
      const response = await fetch(path, {
        method: "POST",
        headers: { ...headers, "x-csrf-token": this.csrf },
        body,
      }).catch(() => {
        throw new Error("the connection is lost: the outcome is unknown");
      });
      const answer = await response.json().catch(() => ({}));
      if (!response.ok) throw new Error(answer.error ?? `the response is ${response.status}`);
      return answer;
    } finally {
      this.pending.delete(sent);
    }
  },
};

/** Connects the button of the bar with the dialog. */
export function signIn(h, changed) {
  const name = h("input", { name: "user", autocomplete: "username", required: true, spellcheck: "false" });
  const password = h("input", { name: "password", type: "password", autocomplete: "current-password", required: true });
  const fault = h("p", { class: "fault", role: "alert" });
  const dialog = h("dialog", { "aria-labelledby": "sign-title" },
    h("form", { method: "dialog", class: "form" },
      h("h2", { id: "sign-title", text: "Sign in" }),
      h("p", { class: "muted", text: "Operators may write, call, start and halt." }),
      h("label", {}, h("span", { text: "User" }), name),
      h("label", {}, h("span", { text: "Password" }), password),
      fault,
      h("div", { class: "actions" },
        h("button", { type: "button", class: "button quiet", text: "Cancel", onclick: () => dialog.close() }),
        h("button", { type: "submit", class: "button", text: "Sign in" }))));
  document.body.append(dialog);
  dialog.querySelector("form").addEventListener("submit", async (event) => {
    event.preventDefault();
    say(fault, "");
    try {
      session.take(await session.post("/sign-in", { user: name.value, password: password.value }));
      dialog.close();
      announce(`signed in as ${session.user}`);
      changed();
    } catch (error) {
      say(fault, error.message);
    }
    password.value = "";
  });
  document.getElementById("sign").addEventListener("click", async () => {
    if (!session.user) {
      say(fault, "");
      dialog.showModal();
      return;
    }
    session.take(await session.post("/sign-out", {}));
    announce("signed out");
    changed();
  });
}
