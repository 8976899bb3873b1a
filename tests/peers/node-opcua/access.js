"use strict";
// access.js URL FOLDER NODE VALUE WAYS USERS USER PASSWORD: tries each way (None, Basic256Sha256/Sign, ..) with each kind of
// user (anonymous, password, certificate, wrong, nobody), reads and writes the node. A JSON line for each try. FOLDER has the
// pairs that opcua_access.py makes.
const fs = require("fs");
const path = require("path");
const {
  AttributeIds, DataType, MessageSecurityMode, OPCUAClient, SecurityPolicy, UserTokenType,
} = require("node-opcua-client");
const { OPCUACertificateManager } = require("node-opcua-certificate-manager");

// Of an error that names a status, the name.
function statusOf(error) {
  const found = /Bad[A-Za-z]+/.exec(`${error.response ? error.response.responseHeader.serviceResult : ""} ${error.message}`);
  return found ? found[0] : String(error.message);
}

function identity(user, name, password, folder) {
  switch (user) {
    case "anonymous":
      return { type: UserTokenType.Anonymous };
    case "certificate":
      return {
        type: UserTokenType.Certificate,
        certificateData: fs.readFileSync(path.join(folder, "user_certificate.der")),
        privateKey: fs.readFileSync(path.join(folder, "user_key.pem"), "utf8"),
      };
    default:
      return {
        type: UserTokenType.UserName,
        userName: user === "nobody" ? "nobody" : name,
        password: user === "wrong" ? "another one" : password,
      };
  }
}

async function tried([url, folder, node, value], [policy, mode], info) {
  const clientCertificateManager = new OPCUACertificateManager({
    rootFolder: path.join(folder, "node-opcua"),
    automaticallyAcceptUnknownCertificate: true,
  });
  await clientCertificateManager.initialize();
  const client = OPCUAClient.create({
    applicationUri: "urn:ua-bridge:system-tests:client",
    applicationName: "client",
    clientCertificateManager,
    certificateFile: path.join(folder, "client_certificate.der"),
    privateKeyFile: path.join(folder, "client_key.pem"),
    securityPolicy: SecurityPolicy[policy],
    securityMode: MessageSecurityMode[mode || "None"],
    connectionStrategy: { maxRetry: 0 },
    endpointMustExist: false,
  });
  const said = {};
  try {
    await client.connect(url);
    const session = await client.createSession(info);
    said.connected = "Good";
    const read = await session.read({ nodeId: node, attributeId: AttributeIds.Value });
    said.read = read.statusCode.name;
    const written = { value: { dataType: DataType.Double, value: Number(value) } };
    const status = await session.write({ nodeId: node, attributeId: AttributeIds.Value, value: written });
    said.write = status.name;
    await session.close();
  } catch (error) {
    said.connected = statusOf(error);
  }
  await client.disconnect();
  await clientCertificateManager.dispose();
  return said;
}

async function main([url, folder, node, value, ways, users, name, password]) {
  for (const way of ways.split(",")) {
    const [security, mode] = way.split("/");
    for (const user of users.split(",")) {
      const info = identity(user, name, password, folder);
      const said = await tried([url, folder, node, value], [security, mode], info);
      console.log(JSON.stringify({ security, mode, user, ...said }));
    }
  }
}

main(process.argv.slice(2)).then(() => process.exit(0), (error) => {
  console.error(error);
  process.exit(1);
});
