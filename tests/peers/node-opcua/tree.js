"use strict";
// tree.js URL: reads what every node of a server has to have, as ../opcua_tree.py does: a JSON line for each attribute that is
// bad, and one with how many nodes and attributes there are.
const { AttributeIds: A, BrowseDirection, MessageSecurityMode, NodeClass, OPCUAClient, SecurityPolicy } = require("node-opcua-client");

const EVERY = ["NodeId", "NodeClass", "BrowseName", "DisplayName"];
// OPC 10000-3, tables 2 to 23.
const OF_CLASS = {
  [NodeClass.Object]: ["EventNotifier"],
  [NodeClass.Variable]: ["Value", "DataType", "ValueRank", "AccessLevel", "UserAccessLevel", "Historizing"],
  [NodeClass.Method]: ["Executable", "UserExecutable"],
  [NodeClass.ObjectType]: ["IsAbstract"],
  [NodeClass.VariableType]: ["DataType", "ValueRank", "IsAbstract"],
  [NodeClass.ReferenceType]: ["IsAbstract", "Symmetric"],
  [NodeClass.DataType]: ["IsAbstract"],
  [NodeClass.View]: ["ContainsNoLoops", "EventNotifier"],
};
const AT_ONCE = 40;
const HIERARCHICAL = "ns=0;i=33";

const say = (what) => console.log(JSON.stringify(what));

async function browsed(session) {
  const found = new Map([["ns=0;i=84", NodeClass.Object]]);
  let waiting = [...found.keys()];
  while (waiting.length) {
    const part = waiting.splice(0, AT_ONCE);
    const results = await session.browse(
      part.map((nodeId) => ({
        nodeId, browseDirection: BrowseDirection.Forward, referenceTypeId: HIERARCHICAL, includeSubtypes: true, resultMask: 63,
      })),
    );
    for (let result of results) {
      for (;;) {
        if (!result.statusCode.isGood()) {
          throw new Error(`a node is not browsed: ${result.statusCode.name}`);
        }
        for (const { nodeId, nodeClass } of result.references || []) {
          const id = nodeId.toString();
          if (!found.has(id)) {
            found.set(id, nodeClass);
            waiting.push(id);
          }
        }
        if (!result.continuationPoint || !result.continuationPoint.length) {
          break;
        }
        result = await session.browseNext(result.continuationPoint, false);
      }
    }
  }
  return found;
}

async function main([url]) {
  const client = OPCUAClient.create({
    endpointMustExist: false,
    securityMode: MessageSecurityMode.None,
    securityPolicy: SecurityPolicy.None,
    connectionStrategy: { maxRetry: 3 },
  });
  await client.connect(url);
  const session = await client.createSession();
  const found = [...(await browsed(session))];
  let [read, bad] = [0, 0];
  for (let start = 0; start < found.length; start += AT_ONCE) {
    const asked = found.slice(start, start + AT_ONCE).flatMap(([nodeId, kind]) =>
      [...EVERY, ...OF_CLASS[kind]].map((name) => ({ nodeId, name, attributeId: A[name] })),
    );
    const answers = await session.read(asked.map(({ nodeId, attributeId }) => ({ nodeId, attributeId })));
    answers.forEach(({ statusCode }, at) => {
      read += 1;
      if (!statusCode.isGood()) {
        bad += 1;
        say({ node: asked[at].nodeId, attribute: asked[at].name, status: statusCode.name });
      }
    });
  }
  say({ nodes: found.length, read, bad });
  await session.close();
  await client.disconnect();
}

main(process.argv.slice(2)).then(() => process.exit(0), (error) => {
  console.error(error);
  process.exit(1);
});
