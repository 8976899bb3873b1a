"use strict";
// ask.js URL: asks for calls of the space as Methods, as ../calls/opcua_asker.py does: an order on a line of standard input,
// {"id": 1, "case": "bundled", "service": PATH, "first": 0, "count": 10}, and a line for what became of it.
const readline = require("readline");
const { DataType, MessageSecurityMode, OPCUAClient, SecurityPolicy, VariantArrayType, promoteOpaqueStructure } = {
  ...require("node-opcua-client"),
  ...require("node-opcua-client-dynamic-extension-object"),
};

const HALF = 0x80000000;
const done = (answer, message) => answer.success === true && answer.message === message;
const begun = (answer) => answer.success === true;
// As ../calls/cases.py says; an Int64 is a pair of numbers here.
const CASES = {
  bundled: {
    ask: (number) => ({ data: number % 2 === 1 }),
    right: (answer, number) => answer.success === (number % 2 === 1) && answer.message === (number % 2 ? "odd" : "even"),
  },
  files: {
    ask: (number) => ({
      bool_value: true, float64_value: number / 8, int16_value: -number, uint64_value: [HALF, number], string_value: `é ${number}`,
    }),
    right: (answer, number) =>
      answer.bool_value === false && answer.float64_value === number / 4 && answer.int16_value === -number &&
      answer.uint64_value[0] === HALF && answer.uint64_value[1] === number && answer.string_value === `é ${number}`.repeat(2),
  },
  empty: { ask: () => ({}), right: (answer) => done(answer, "done") },
  megabyte: { ask: () => ({}), right: (answer) => done(answer, "0123456789".repeat(100000)) },
  messages: {
    ask: () => ({}),
    right: (answer) => JSON.stringify(answer.available_states.map((one) => [one.id, one.label])) === '[[0,"one"],[1,""],[2,"drei"]]',
  },
  skill: { ask: () => ({}), right: begun },
  grasp: { ask: (number) => ({ Force: 10 + number }), right: begun },
};

async function found(session, path) {
  let [object, node] = [null, "ns=0;i=85"];
  for (const name of path.split("/")) {
    const { references } = await session.browse({ nodeId: node, browseDirection: 0, resultMask: 63 });
    const next = (references || []).find((one) => one.browseName.name === name);
    if (!next) {
      return null;
    }
    [object, node] = [node, next.nodeId];
  }
  const { inputArguments, outputArguments } = await session.getArgumentDefinition(node);
  return { object, method: node, inputArguments, outputArguments };
}

const ZERO = { [DataType.Boolean]: false, [DataType.String]: "", [DataType.Int64]: [0, 0], [DataType.UInt64]: [0, 0] };

async function called(session, place, given) {
  const inputArguments = place.inputArguments.map((one) => {
    const dataType = one.dataType.value;
    return { dataType, arrayType: VariantArrayType.Scalar, value: given[one.name] ?? ZERO[dataType] ?? 0 };
  });
  const answer = await session.call({
    objectId: place.object, methodId: place.method, inputArguments: Object.keys(given).length ? inputArguments : [],
  });
  if (!answer.statusCode.isGood()) {
    return { why: answer.statusCode.name };
  }
  const values = answer.outputArguments || [];
  await promoteOpaqueStructure(session, values.map((value) => ({ value })));
  return { answer: Object.fromEntries(values.map((one, at) => [place.outputArguments[at].name, one.value])) };
}

async function asked(session, places, order) {
  const { ask, right } = CASES[order.case];
  const end = Date.now() + 1000 * (order.wait ?? 20);
  while (!(places[order.service] ??= await found(session, order.service))) {
    if (Date.now() > end) {
      return { absent: true };
    }
    await new Promise((resolve) => setTimeout(resolve, 50));
  }
  const told = { right: 0, wrong: [], wrongs: 0, failed: [], failures: 0 };
  const first = order.first ?? 0;
  for (let number = first; number < first + (order.count ?? 1); number += 1) {
    const { answer, why } = await called(session, places[order.service], ask(number)).catch((error) => ({ why: String(error) }));
    if (why !== undefined) {
      told.failures += 1;
      told.failed.push(why);
    } else if (right(answer, number)) {
      told.right += 1;
    } else {
      told.wrongs += 1;
      told.wrong.push(JSON.stringify(answer).slice(0, 300));
    }
  }
  return told;
}

async function main([url]) {
  const client = OPCUAClient.create({
    endpointMustExist: false,
    securityMode: MessageSecurityMode.None,
    securityPolicy: SecurityPolicy.None,
    connectionStrategy: { maxRetry: 3 },
    transportSettings: { maxMessageSize: 16 * 1024 * 1024, maxChunkCount: 0 },
  });
  await client.connect(url);
  const session = await client.createSession();
  console.log(JSON.stringify({ ready: url }));
  const places = {};
  for await (const line of readline.createInterface({ input: process.stdin })) {
    const order = JSON.parse(line);
    console.log(JSON.stringify({ id: order.id, answer: await asked(session, places, order) }));
  }
}

main(process.argv.slice(2)).then(() => process.exit(0), (error) => {
  console.error(error);
  process.exit(1);
});
