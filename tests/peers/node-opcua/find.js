"use strict";
// find.js URL: what a discovery server knows, a JSON line for FindServers and one for FindServersOnNetwork.
const { findServers, findServersOnNetwork } = require("node-opcua-client");

async function main([url]) {
  const { servers } = await findServers(url);
  console.log(JSON.stringify({
    registered: servers.map((server) => ({
      uri: server.applicationUri,
      name: server.applicationName.text,
      urls: server.discoveryUrls,
    })),
  }));
  const onNetwork = await findServersOnNetwork(url);
  console.log(JSON.stringify({
    network: onNetwork.map((server) => ({
      name: server.serverName,
      url: server.discoveryUrl,
      capabilities: server.serverCapabilities,
    })),
  }));
}

main(process.argv.slice(2)).then(() => process.exit(0), (error) => {
  console.error(error);
  process.exit(1);
});
