"use strict";
// registers.js PORT LDS FILE: a server of node-opcua that registers with a discovery server, over a secured channel. Writes
// its certificate to the file, says its ApplicationUri, and then what becomes of the registration. SIGTERM has it take the
// registration back.
const { OPCUAServer, RegisterServerMethod } = require("node-opcua-server");
const { OPCUACertificateManager } = require("node-opcua-certificate-manager");
const fs = require("fs");
const path = require("path");

function say(line) {
  console.log(JSON.stringify(line));
}

async function main([port, lds, file]) {
  const serverCertificateManager = new OPCUACertificateManager({
    rootFolder: path.join(process.env.HOME, "server-pki"),
    automaticallyAcceptUnknownCertificate: true,
  });
  await serverCertificateManager.initialize();
  const server = new OPCUAServer({
    port: Number(port),
    serverCertificateManager,
    registerServerMethod: RegisterServerMethod.LDS,
    discoveryServerEndpointUrl: lds,
    capabilitiesForMDNS: ["DA", "AC"],
  });
  for (const happened of ["serverRegistered", "serverRegistrationPending", "serverUnregistered"]) {
    server.on(happened, () => say({ happened }));
  }
  await server.initialize();
  fs.writeFileSync(file, server.getCertificate());
  say({ ready: true, uri: server.serverInfo.applicationUri });
  await server.start();
  say({ started: true });
  process.on("SIGTERM", async () => {
    await server.shutdown(0);
    process.exit(0);
  });
}

main(process.argv.slice(2)).catch((error) => {
  console.error(error);
  process.exit(1);
});
