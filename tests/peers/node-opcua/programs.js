"use strict";
// programs.js PORT LDS FILE: a server of node-opcua as a machine that knows Programs of OPC 10000-10 and nothing of the space. Its object
// `machine` has Weld, a Program with a parameter, a result and a run of some seconds. It registers with the discovery server by
// itself, writes its certificate to the file, takes secured channels only, and says what is called there.
const { OPCUAServer, RegisterServerMethod } = require("node-opcua-server");
const { OPCUACertificateManager } = require("node-opcua-certificate-manager");
const { promoteToStateMachine } = require("node-opcua-address-space");
const { DataType } = require("node-opcua-variant");
const { StatusCodes } = require("node-opcua-status-code");
const { MessageSecurityMode, SecurityPolicy } = require("node-opcua-client");
const fs = require("fs");
const path = require("path");

// node-opcua samples a state once a second.
const RUN_MS = 2500;

function say(line) {
  console.log(JSON.stringify(line));
}

function weld(addressSpace, machine, space) {
  const type = addressSpace.findObjectType("ProgramStateMachineType");
  const methods = ["Start", "Halt", "Suspend", "Resume", "Reset"];
  const node = type.instantiate({
    browseName: "Weld",
    componentOf: machine,
    namespace: space,
    optionals: ["FinalResultData"],
  });
  const program = promoteToStateMachine(node);
  const group = space.addObject({ componentOf: node, browseName: "ParameterSet" });
  const double = (parent, browseName, value) =>
    space.addVariable({
      componentOf: parent,
      browseName,
      dataType: "Double",
      accessLevel: "CurrentRead | CurrentWrite",
      userAccessLevel: "CurrentRead | CurrentWrite",
      value: { dataType: DataType.Double, value },
    });
  const force = double(group, "Force", 20);
  const used = double(node.finalResultData, "ForceUsed", 0);
  let run = null;
  const on = {
    Start: () => {
      program.setState("Running");
      say({ started: force.readValue().value.value });
      run = setTimeout(() => {
        used.setValueFromSource({ dataType: DataType.Double, value: force.readValue().value.value });
        program.setState("Ready");
      }, RUN_MS);
    },
    Halt: () => {
      clearTimeout(run);
      program.setState("Halted");
      say({ halted: true });
    },
    Reset: () => program.setState("Ready"),
  };
  for (const name of methods) {
    const method = space.addMethod(node, { browseName: { name, namespaceIndex: 0 } });
    method.bindMethod((_inputs, _context, done) => {
      const statusCode = on[name] ? StatusCodes.Good : StatusCodes.BadNotSupported;
      if (on[name]) on[name]();
      done(null, { statusCode, outputArguments: [] });
    });
  }
  program.setState("Halted");
}

async function main([port, lds, file]) {
  const serverCertificateManager = new OPCUACertificateManager({
    rootFolder: path.join(process.env.HOME, "welder-pki"),
    automaticallyAcceptUnknownCertificate: true,
  });
  await serverCertificateManager.initialize();
  const server = new OPCUAServer({
    port: Number(port),
    serverCertificateManager,
    registerServerMethod: RegisterServerMethod.LDS,
    discoveryServerEndpointUrl: lds,
    securityPolicies: [SecurityPolicy.Basic256Sha256],
    securityModes: [MessageSecurityMode.SignAndEncrypt],
  });
  server.on("serverRegistered", () => say({ happened: "serverRegistered" }));
  await server.initialize();
  fs.writeFileSync(file, server.getCertificate());
  const addressSpace = server.engine.addressSpace;
  const space = addressSpace.getOwnNamespace();
  const machine = space.addObject({ organizedBy: addressSpace.rootFolder.objects, browseName: "machine" });
  weld(addressSpace, machine, space);
  say({ ready: true, uri: server.serverInfo.applicationUri });
  await server.start();
  process.on("SIGTERM", async () => {
    await server.shutdown(0);
    process.exit(0);
  });
}

main(process.argv.slice(2)).catch((error) => {
  console.error(error);
  process.exit(1);
});
