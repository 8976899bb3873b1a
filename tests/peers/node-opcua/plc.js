"use strict";
// plc.js PORT [POLICY PAIRS]: a server of node-opcua that knows nothing of the space. Line.Speed is set by JSON lines on standard
// input, as {"set": 1.5}; what clients write to Line.Setpoint is said. With a POLICY, and the folder of `opcua_access.py pairs`, it
// takes nobody without that security policy.
const { OPCUAServer } = require("node-opcua-server");
const { OPCUACertificateManager } = require("node-opcua-certificate-manager");
const { DataType, Variant } = require("node-opcua-variant");
const { StatusCodes } = require("node-opcua-status-code");
const { MessageSecurityMode, SecurityPolicy } = require("node-opcua-client");
const path = require("path");
const readline = require("readline");

function say(line) {
  console.log(JSON.stringify(line));
}

// What a server needs that takes one policy only.
function only(policy, pairs) {
  return {
    securityPolicies: [SecurityPolicy[policy]],
    securityModes: [MessageSecurityMode.SignAndEncrypt],
    serverInfo: { applicationUri: "urn:ua-bridge:system-tests:plc" },
    certificateFile: path.join(pairs, "server_certificate.der"),
    privateKeyFile: path.join(pairs, "server_key.pem"),
  };
}

async function main([port, policy, pairs]) {
  const serverCertificateManager = new OPCUACertificateManager({
    rootFolder: path.join(process.env.HOME, `plc-pki-${port}`),
    automaticallyAcceptUnknownCertificate: true,
  });
  await serverCertificateManager.initialize();
  const server = new OPCUAServer({
    port: Number(port),
    serverCertificateManager,
    ...(policy ? only(policy, pairs) : {}),
  });
  await server.initialize();
  const addressSpace = server.engine.addressSpace;
  const space = addressSpace.registerNamespace("urn:ua-bridge:system-tests:plc");
  const line = space.addObject({
    organizedBy: addressSpace.rootFolder.objects,
    nodeId: "s=Line",
    browseName: "Line",
  });
  const variable = (name) =>
    space.addVariable({
      componentOf: line,
      nodeId: `s=Line.${name}`,
      browseName: name,
      dataType: "Double",
      minimumSamplingInterval: 20,
      value: { dataType: DataType.Double, value: 0.5 },
    });
  const speed = variable("Speed");
  const setpoint = variable("Setpoint");
  setpoint.on("value_changed", (data) => say({ written: data.value.value }));
  await server.start();
  say({ ready: true });
  readline.createInterface({ input: process.stdin }).on("line", (text) => {
    const value = new Variant({ dataType: DataType.Double, value: JSON.parse(text).set });
    speed.setValueFromSource(value, StatusCodes.Good);
    say({ set: true });
  });
  process.on("SIGTERM", async () => {
    await server.shutdown(0);
    process.exit(0);
  });
}

main(process.argv.slice(2)).catch((error) => {
  console.error(error);
  process.exit(1);
});
