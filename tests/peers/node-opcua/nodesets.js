"use strict";
// nodesets.js FILE...: loads NodeSet2 files in one call, with that of the core namespace, and prints a JSON line with the
// supertypes of the object types that are then in the first namespace of the first file.
const { readFileSync } = require("node:fs");
const { AddressSpace } = require("node-opcua-address-space");
const { generateAddressSpace } = require("node-opcua-address-space/nodeJS");
const { NodeClass } = require("node-opcua-data-model");
const { nodesets } = require("node-opcua-nodesets");

async function main(files) {
  const space = AddressSpace.create();
  await generateAddressSpace(space, [nodesets.standard, ...files]);
  const [, uri] = /<Uri>([^<]*)<\/Uri>/.exec(readFileSync(files[0], "utf8"));
  const types = {};
  for (const node of space.getNamespace(uri).nodeIterator()) {
    if (node.nodeClass === NodeClass.ObjectType) {
      types[node.browseName.name] = node.subtypeOfObj.browseName.name;
    }
  }
  console.log(JSON.stringify(types));
  space.dispose();
}

main(process.argv.slice(2)).catch((error) => {
  console.error(error);
  process.exit(1);
});
