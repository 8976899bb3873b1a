"use strict";
// plc.js PORT: a server of node-opcua that knows nothing of the space. Line.Speed is set by JSON lines on standard input, as
// {"set": 1.5}; what clients write to Line.Setpoint is said.
const { OPCUAServer } = require("node-opcua-server");
const { OPCUACertificateManager } = require("node-opcua-certificate-manager");
const { DataType, Variant } = require("node-opcua-variant");
const { StatusCodes } = require("node-opcua-status-code");
const path = require("path");
const readline = require("readline");

function say(line) {
  console.log(JSON.stringify(line));
}

async function main([port]) {
  const serverCertificateManager = new OPCUACertificateManager({
    rootFolder: path.join(process.env.HOME, "plc-pki"),
    automaticallyAcceptUnknownCertificate: true,
  });
  await serverCertificateManager.initialize();
  const server = new OPCUAServer({ port: Number(port), serverCertificateManager });
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
