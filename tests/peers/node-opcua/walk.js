"use strict";
// walk.js URL NAMESPACE_URI: calls every method of skill 1, which does not end by itself, in every state, and runs skill 2,
// which does. Says each call and each transition event as a JSON line, as opcua_skill.py does.
const {
  AttributeIds, ClientMonitoredItem, ClientSubscription, MessageSecurityMode, OPCUAClient, SecurityPolicy,
  TimestampsToReturn, constructEventFilter,
} = require("node-opcua-client");

const FIELDS = [
  "EventType", "SourceName", "Severity", "Message", "FromState", "FromState.Id", "FromState.Number", "ToState",
  "ToState.Id", "ToState.Number", "Transition", "Transition.Id", "Transition.Number",
];
const METHODS = { Start: 5, Halt: 6, Suspend: 7, Resume: 8, Reset: 9 };
const OF_THE_TYPE = { Start: 2426 };
const WAYS = {
  Halted: [],
  Ready: ["Reset"],
  Running: ["Reset", "Start"],
  Suspended: ["Reset", "Start", "Suspend"],
};

const say = (what) => console.log(JSON.stringify(what));

// LocalizedTexts by their text, NodeIds as they are written, all else as it is.
function plain(value) {
  if (value === null || value === undefined) {
    return null;
  }
  if (value.text !== undefined) {
    return value.text;
  }
  if (value.identifierType !== undefined) {
    return value.toString().replace(/^ns=0;/, "");
  }
  return value;
}

class Skill {
  constructor(session, ns, number) {
    this.session = session;
    this.first = 100 * number;
    this.node = (offset) => `ns=${ns};i=${this.first + offset}`;
  }

  async children(nodeId) {
    const { references } = await this.session.browse(nodeId);
    return Object.fromEntries(references.map((one) => [one.browseName.name, one.nodeId]));
  }

  async begin() {
    this.members = await this.children(this.node(0));
    this.ofState = await this.children(this.members.CurrentState);
  }

  async read(nodeId, attributeId = AttributeIds.Value) {
    return (await this.session.read({ nodeId, attributeId })).value.value;
  }

  async shown() {
    const nodes = [this.members.CurrentState, this.ofState.Number, this.members.RunId, this.members.LastTransition];
    const values = [];
    for (const node of nodes) {
      values.push(plain(await this.read(node)));
    }
    return [await this.state(), ...values];
  }

  async state() {
    const id = await this.read(this.ofState.Id);
    return { 2406: "Halted", 2400: "Ready", 2402: "Running", 2404: "Suspended" }[id.value];
  }

  async call(method, ofType) {
    const methodId = ofType && OF_THE_TYPE[method] ? `ns=0;i=${OF_THE_TYPE[method]}` : this.node(METHODS[method]);
    const { statusCode } = await this.session.call({ objectId: this.node(0), methodId, inputArguments: [] });
    return statusCode.name;
  }
}

async function until(what) {
  for (let times = 0; times < 1000; times += 1) {
    if (await what()) {
      return;
    }
    await new Promise((resolve) => setTimeout(resolve, 20));
  }
  throw new Error("it does not come");
}

async function events(session, skills) {
  const subscription = ClientSubscription.create(session, { requestedPublishingInterval: 20, publishingEnabled: true });
  const seen = new Set();
  for (const skill of skills) {
    const item = ClientMonitoredItem.create(
      subscription,
      { nodeId: skill.node(0), attributeId: AttributeIds.EventNotifier },
      { filter: constructEventFilter(FIELDS), queueSize: 100, discardOldest: true, samplingInterval: 0 },
      TimestampsToReturn.Both,
    );
    item.on("changed", (fields) => {
      const event = Object.fromEntries(FIELDS.map((name, at) => [name, plain(fields[at].value)]));
      seen.add(event["Transition.Number"]);
      say({ event });
    });
    await new Promise((resolve) => item.once("initialized", resolve));
  }
  return seen;
}

async function main([url, uri]) {
  const client = OPCUAClient.create({
    endpointMustExist: false,
    securityMode: MessageSecurityMode.None,
    securityPolicy: SecurityPolicy.None,
    connectionStrategy: { maxRetry: 3 },
  });
  await client.connect(url);
  const session = await client.createSession();
  const ns = (await session.readNamespaceArray()).indexOf(uri);
  const [skill, quick] = [new Skill(session, ns, 1), new Skill(session, ns, 2)];
  await skill.begin();
  await quick.begin();
  const seen = await events(session, [skill, quick]);
  for (const [state, way] of Object.entries(WAYS)) {
    for (const method of Object.keys(METHODS)) {
      if ((await skill.state()) !== "Halted") {
        await skill.call("Halt");
      }
      for (const step of way) {
        const status = await skill.call(step);
        if (status !== "Good") {
          throw new Error(`${step} on the way to ${state}: ${status}`);
        }
      }
      const before = await skill.shown();
      const executable = await skill.read(skill.node(METHODS[method]), AttributeIds.Executable);
      const status = await skill.call(method, method === "Start");
      say({ state, method, executable, status, before, after: await skill.shown() });
    }
  }
  await quick.call("Reset");
  await quick.call("Start");
  await until(async () => (await quick.state()) === "Ready");
  const result = {};
  for (const [name, node] of Object.entries(await quick.children(quick.members.FinalResultData))) {
    result[name] = plain(await quick.read(node));
  }
  const [state, , , run] = await quick.shown();
  say({ result, state, run });
  const diagnostic = await quick.read(quick.members.ProgramDiagnostic);
  say({ diagnostic: { method: diagnostic.lastMethodCall, status: diagnostic.lastMethodReturnStatus.name } });
  await until(async () => seen.size === 9);
  await session.close();
  await client.disconnect();
}

main(process.argv.slice(2)).then(() => process.exit(0), (error) => {
  console.error(error);
  process.exit(1);
});
