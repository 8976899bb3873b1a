"use strict";
// across.js LDS NEIGHBOUR: a client of node-opcua that knows its own discovery server alone. For each path of names below Objects, a
// JSON list as a line on standard input, it asks that for the server called NEIGHBOUR and calls the Method at the end of the path
// there, until it is answered Good, and says when that was, in milliseconds since 1970.
const { MessageSecurityMode, OPCUAClient, SecurityPolicy, findServers } = require("node-opcua-client");
const readline = require("readline");

const LOOK_EVERY_MS = 5;
const LONGEST_MS = 60000;

const pause = () => new Promise((resolve) => setTimeout(resolve, LOOK_EVERY_MS));

async function neighbour(lds, name) {
  const { servers } = await findServers(lds);
  const found = servers.find((server) => server.applicationName.text === name);
  return found && found.discoveryUrls[0];
}

async function found(session, path) {
  let [object, node] = [null, "ns=0;i=85"];
  for (const name of path) {
    const { references } = await session.browse({ nodeId: node, browseDirection: 0, resultMask: 63 });
    const next = (references || []).find((one) => one.browseName.name === name);
    if (!next) {
      return null;
    }
    [object, node] = [node, next.nodeId];
  }
  return { objectId: object, methodId: node, inputArguments: [] };
}

async function called(url, path, until) {
  const client = OPCUAClient.create({
    endpointMustExist: false,
    securityMode: MessageSecurityMode.None,
    securityPolicy: SecurityPolicy.None,
    connectionStrategy: { maxRetry: 0 },
  });
  await client.connect(url);
  const session = await client.createSession();
  while (Date.now() < until) {
    const call = await found(session, path);
    const answer = call && (await session.call(call));
    if (answer && answer.statusCode.name === "Good") {
      console.log(JSON.stringify({ answered_ms: Date.now() }));
      break;
    }
    await pause();
  }
  await session.close();
  await client.disconnect();
}

async function run(lds, name, path) {
  const until = Date.now() + LONGEST_MS;
  while (Date.now() < until) {
    const url = await neighbour(lds, name);
    if (url) {
      await called(url, path, until);
      return;
    }
    await pause();
  }
}

const [lds, name] = process.argv.slice(2);
let last = Promise.resolve();
readline.createInterface({ input: process.stdin }).on("line", (text) => {
  last = last.then(() => run(lds, name, JSON.parse(text))).catch((error) => {
    console.error(error);
    process.exit(1);
  });
});
console.log(JSON.stringify({ ready: true }));
