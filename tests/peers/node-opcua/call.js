"use strict";
// call.js URL PATH VALUES..: finds a Method by its path below Objects, says what it takes and gives, and calls it once for
// each VALUES, a JSON list of arguments. A JSON line for each answer.
const {
  MessageSecurityMode, OPCUAClient, SecurityPolicy, VariantArrayType,
} = require("node-opcua-client");

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
  return { object, method: node };
}

async function main([url, path, ...values]) {
  const client = OPCUAClient.create({
    endpointMustExist: false,
    securityMode: MessageSecurityMode.None,
    securityPolicy: SecurityPolicy.None,
    connectionStrategy: { maxRetry: 3 },
  });
  await client.connect(url);
  const session = await client.createSession();
  const end = Date.now() + 30000;
  let place = await found(session, path);
  while (!place && Date.now() < end) {
    await new Promise((resolve) => setTimeout(resolve, 50));
    place = await found(session, path);
  }
  if (!place) {
    throw new Error(`${path} is not there`);
  }
  const { inputArguments, outputArguments } = await session.getArgumentDefinition(place.method);
  const described = (list) => list.map((one) => [one.name, one.dataType.value, one.valueRank]);
  console.log(JSON.stringify({ takes: described(inputArguments), gives: described(outputArguments) }));
  for (const text of values) {
    const given = JSON.parse(text).map((value, at) => ({
      dataType: inputArguments[at].dataType.value,
      arrayType: inputArguments[at].valueRank > 0 ? VariantArrayType.Array : VariantArrayType.Scalar,
      value,
    }));
    const answer = await session.call({ objectId: place.object, methodId: place.method, inputArguments: given });
    const value = (answer.outputArguments || []).map((one) => one.value);
    console.log(JSON.stringify({ status: answer.statusCode.name, value }));
  }
  await session.close();
  await client.disconnect();
}

main(process.argv.slice(2)).then(() => process.exit(0), (error) => {
  console.error(error);
  process.exit(1);
});
