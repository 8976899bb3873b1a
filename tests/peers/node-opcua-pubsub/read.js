"use strict";
// read.js: reads values of JSON by metadata with node-opcua-pubsub-expander, which knows the reversible form of version 1.04.
// Each line of standard input is an order, {"read": a ua-data message, "by": its ua-metadata message}, and is answered by a
// line, {"fields": [[name, value], ..]}: the fields that the reader group associates with a target variable.
const readline = require("readline");
const { constructVariableFieldAssociation, MyMqttJsonReaderGroupDataType } = require("node-opcua-pubsub-expander");
const { DataSetMetaDataType, TargetVariablesDataType } = require("node-opcua-types");
const { coerceNodeId } = require("node-opcua-nodeid");
const { decodeOPCUA_JSON } = require("node-opcua-json");

const VALUE = 13;

function group({ PublisherId, DataSetWriterId, MetaData }) {
  const dataSetMetaData = decodeOPCUA_JSON(DataSetMetaDataType, MetaData);
  const targetVariables = dataSetMetaData.fields.map(({ name }) => ({
    attributeId: VALUE,
    targetNodeId: coerceNodeId(`s=${name}`),
  }));
  return new MyMqttJsonReaderGroupDataType({
    name: "judge",
    enabled: true,
    transportSettings: {},
    messageSettings: {},
    dataSetReaders: [{
      name: "judge",
      enabled: true,
      publisherId: { dataType: "String", value: PublisherId },
      dataSetWriterId: Number(DataSetWriterId),
      dataSetMetaData,
      subscribedDataSet: new TargetVariablesDataType({ targetVariables }),
      transportSettings: {},
      messageSettings: {},
    }],
  });
}

console.log(JSON.stringify({ ready: true }));
readline.createInterface({ input: process.stdin }).on("line", (line) => {
  const order = JSON.parse(line);
  const found = constructVariableFieldAssociation(order.read, group(order.by));
  console.log(JSON.stringify({ fields: found.map(({ targetVariable, value }) => [targetVariable.targetNodeId.value, value.Body]) }));
});
