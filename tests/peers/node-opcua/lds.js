"use strict";
// lds.js PORT [PERIOD]: node-opcua's discovery server. Says `ready`, and then a JSON line whenever what it sees on the network
// is another, and one whenever who is registered is. It is asked each PERIOD ms (100).
const { OPCUADiscoveryServer } = require("node-opcua-server-discovery");
const { findServers, findServersOnNetwork } = require("node-opcua-client");
const path = require("path");
const { OPCUACertificateManager } = require("node-opcua-certificate-manager");

async function main([port, period = "100"]) {
  const serverCertificateManager = new OPCUACertificateManager({
    rootFolder: path.join(process.env.HOME, "pki"),
    automaticallyAcceptUnknownCertificate: true,
  });
  await serverCertificateManager.initialize();
  const server = new OPCUADiscoveryServer({ port: Number(port), serverCertificateManager });
  await server.start();
  console.log("ready");
  let last = "";
  let lastRegistered = "";
  for (;;) {
    const found = await findServersOnNetwork(`opc.tcp://127.0.0.1:${port}`);
    const seen = JSON.stringify(found.map((server) => ({
      name: server.serverName,
      url: server.discoveryUrl,
      capabilities: server.serverCapabilities,
    })));
    if (seen !== last) {
      last = seen;
      console.log(`{"network":${seen},"at_ms":${Date.now()}}`);
    }
    const { servers } = await findServers(`opc.tcp://127.0.0.1:${port}`);
    const registered = JSON.stringify(servers.map((server) => server.applicationUri));
    if (registered !== lastRegistered) {
      lastRegistered = registered;
      console.log(`{"registered":${registered}}`);
    }
    await new Promise((resolve) => setTimeout(resolve, Number(period)));
  }
}

main(process.argv.slice(2)).catch((error) => {
  console.error(error);
  process.exit(1);
});
