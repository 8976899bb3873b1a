"use strict";
// bench.js PORT COUNT PAIRS: a server of node-opcua that is measured beside others, with the nodes and by the lines of
// opcua_bench.py. PAIRS is the folder of `opcua_access.py pairs`.
const { OPCUAServer } = require("node-opcua-server");
const { OPCUACertificateManager } = require("node-opcua-certificate-manager");
const { DataType, Variant } = require("node-opcua-variant");
const { StatusCodes } = require("node-opcua-status-code");
const path = require("path");
const readline = require("readline");

const PERIOD = 103;

function say(line) {
  console.log(JSON.stringify(line));
}

// Microseconds of the machine's monotonic clock.
function now() {
  return Number(process.hrtime.bigint()) / 1e3;
}

function addMethod(space, line) {
  const outputs = [
    { name: "success", dataType: DataType.Boolean },
    { name: "message", dataType: DataType.String },
    { name: "run", dataType: DataType.UInt32 },
  ];
  const method = space.addMethod(line, {
    nodeId: "i=6",
    browseName: "Answer",
    inputArguments: [],
    outputArguments: outputs.map((one) => ({ ...one, description: { text: "" } })),
  });
  method.bindMethod((_inputs, _context, done) => {
    const outputArguments = [
      { dataType: DataType.Boolean, value: true },
      { dataType: DataType.String, value: "Answer" },
      { dataType: DataType.UInt32, value: 1 },
    ];
    done(null, { statusCode: StatusCodes.Good, outputArguments });
  });
}

async function main([port, count, pairs]) {
  const serverCertificateManager = new OPCUACertificateManager({
    rootFolder: path.join(process.env.HOME, "bench-pki"),
    automaticallyAcceptUnknownCertificate: true,
  });
  await serverCertificateManager.initialize();
  const server = new OPCUAServer({
    port: Number(port),
    serverCertificateManager,
    serverInfo: { applicationUri: "urn:ua-bridge:system-tests:plc" },
    certificateFile: path.join(pairs, "server_certificate.der"),
    privateKeyFile: path.join(pairs, "server_key.pem"),
    maxConnectionsPerEndpoint: 100,
  });
  await server.initialize();
  const addressSpace = server.engine.addressSpace;
  const space = addressSpace.registerNamespace("urn:ua-bridge:bench");
  const objects = addressSpace.rootFolder.objects;
  const line = space.addObject({ organizedBy: objects, nodeId: "i=7", browseName: "Line" });
  const add = (id, browseName) =>
    space.addVariable({
      componentOf: line,
      nodeId: `i=${id}`,
      browseName,
      dataType: "Double",
      minimumSamplingInterval: 0,
      value: { dataType: DataType.Double, value: 0 },
    });
  const variables = [];
  for (let number = 0; number < Number(count); number += 1) {
    variables.push(add(10 + number, `v${number}`));
  }
  add(5, "written");
  addMethod(space, line);
  await server.start();
  say({ ready: true });
  let due = 0;
  let timer = null;
  function change() {
    const value = now();
    for (const variable of variables) {
      variable.setValueFromSource(new Variant({ dataType: DataType.Double, value }), StatusCodes.Good);
    }
    due += PERIOD;
    timer = setTimeout(change, Math.max(0, due - now() / 1e3));
  }
  readline.createInterface({ input: process.stdin }).on("line", (text) => {
    clearTimeout(timer);
    if (JSON.parse(text).change) {
      due = now() / 1e3;
      change();
    }
    say({ changed: true });
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
