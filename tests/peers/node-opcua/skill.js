"use strict";
// skill.js URL NAMESPACE_URI K: runs skill K of a component once, and says each transition event as a JSON line; the
// last line has the state and the result it ended with.
const {
  AttributeIds, ClientMonitoredItem, ClientSubscription, MessageSecurityMode, OPCUAClient, SecurityPolicy,
  TimestampsToReturn, constructEventFilter,
} = require("node-opcua-client");

const FIELDS = [
  "EventType", "Message", "Severity", "FromState", "FromState.Id", "ToState", "ToState.Id", "Transition",
  "Transition.Id", "Transition.Number",
];

async function main([url, uri, k]) {
  const client = OPCUAClient.create({
    endpointMustExist: false,
    securityMode: MessageSecurityMode.None,
    securityPolicy: SecurityPolicy.None,
    connectionStrategy: { maxRetry: 3 },
  });
  await client.connect(url);
  const session = await client.createSession();
  const namespaces = await session.readNamespaceArray();
  const ns = namespaces.indexOf(uri);
  if (ns < 0) {
    throw new Error(`${uri} is none of ${namespaces}`);
  }
  const node = (id) => `ns=${ns};i=${id}`;
  const skill = 100 * Number(k);
  const value = async (id) => (await session.read({ nodeId: node(id), attributeId: AttributeIds.Value })).value.value;
  const call = async (id) => {
    const { statusCode } = await session.call({ objectId: node(skill), methodId: node(id), inputArguments: [] });
    return statusCode.name;
  };
  const subscription = ClientSubscription.create(session, { requestedPublishingInterval: 20, publishingEnabled: true });
  const seen = [];
  const item = ClientMonitoredItem.create(
    subscription,
    { nodeId: node(skill), attributeId: AttributeIds.EventNotifier },
    { filter: constructEventFilter(FIELDS), queueSize: 20, discardOldest: true, samplingInterval: 0 },
    TimestampsToReturn.Both,
  );
  const ended = new Promise((resolve) => {
    item.on("changed", (fields) => {
      const of = (name) => fields[FIELDS.indexOf(name)].value;
      const event = {
        type: String(of("EventType")),
        transition: of("Transition").text,
        number: of("Transition.Number"),
        from: of("FromState").text,
        from_id: String(of("FromState.Id")),
        to: of("ToState").text,
        to_id: String(of("ToState.Id")),
      };
      console.log(JSON.stringify(event));
      seen.push(event.to);
      const runs = seen.lastIndexOf("Running");
      if (runs >= 0 && seen.length > runs + 1) {
        resolve();
      }
    });
  });
  await new Promise((resolve) => item.once("initialized", resolve));
  const state = (await value(skill + 1)).text;
  const reset = state === "Halted" ? await call(skill + 9) : "not needed";
  const start = await call(skill + 5);
  await ended;
  console.log(JSON.stringify({ reset, start, state: (await value(skill + 1)).text }));
  await session.close();
  await client.disconnect();
}

main(process.argv.slice(2)).then(() => process.exit(0), (error) => {
  console.error(error);
  process.exit(1);
});
