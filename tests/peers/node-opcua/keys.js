"use strict";
// keys.js URL MODE GROUP STARTING COUNT: asks a Security Key Service for the keys of a group, in a session that is secured
// as MODE says (None, Sign, SignAndEncrypt), and says its status and what it answers as a JSON line.
const { DataType, MessageSecurityMode, OPCUAClient, SecurityPolicy } = require("node-opcua-client");

async function main([url, mode, group, starting, count]) {
  const secured = mode !== "None";
  const client = OPCUAClient.create({
    endpointMustExist: false,
    securityMode: MessageSecurityMode[mode],
    securityPolicy: secured ? SecurityPolicy.Basic256Sha256 : SecurityPolicy.None,
    connectionStrategy: { maxRetry: 3 },
  });
  await client.connect(url);
  const session = await client.createSession();
  const answer = await session.call({
    objectId: "ns=0;i=14443",
    methodId: "ns=0;i=15215",
    inputArguments: [
      { dataType: DataType.String, value: group },
      { dataType: DataType.UInt32, value: Number(starting) },
      { dataType: DataType.UInt32, value: Number(count) },
    ],
  });
  const [policy, first, keys, next, lifetime] = (answer.outputArguments || []).map((one) => one.value);
  console.log(JSON.stringify({
    status: answer.statusCode.name, policy, first, keys: keys && keys.map((key) => key.toString("hex")), next, lifetime,
  }));
  await session.close();
  await client.disconnect();
}

main(process.argv.slice(2)).catch((error) => {
  console.error(error);
  process.exit(1);
});
