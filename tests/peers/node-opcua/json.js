"use strict";
// json.js: reads values as JSON by node-opcua-json, the JSON encoding of OPC 10000-6, 5.4. Each line of standard input is an
// order, {"read": a ua-data message, "by": its ua-metadata message, "scheme": S}, and is answered by a line, {"fields": [[name,
// DataType, text], ..]}. S is Verbose, Compact or DeprecatedReversible.
const readline = require("readline");
const { DataType, VariantArrayType } = require("node-opcua-variant");
const { DataSetMetaDataType } = require("node-opcua-types");
const json = require("node-opcua-json");

const NAMESPACES = ["http://opcfoundation.org/UA/", "urn:judge"];
const NO_STRUCTURES = { getExtensionObjectConstructor: () => { throw new Error("a structure"); } };

// The text of an element, which the test knows too.
const TEXTS = {
  [DataType.Int64]: ([high, low]) => String((BigInt.asIntN(32, BigInt(high)) << 32n) | BigInt(low)),
  [DataType.UInt64]: ([high, low]) => String((BigInt(high) << 32n) | BigInt(low)),
  [DataType.DateTime]: (value) => value.toISOString(),
  [DataType.Guid]: (value) => value.toLowerCase(),
  [DataType.ByteString]: (value) => value.toString("hex"),
  [DataType.StatusCode]: (value) => String(value.value),
  [DataType.LocalizedText]: (value) => `${value.locale}:${value.text}`,
};

function text({ dataType, arrayType, value }) {
  const one = TEXTS[dataType] || String;
  return arrayType === VariantArrayType.Scalar ? one(value) : Array.from(value, one).join(" ");
}

// A field of a concrete type is plain in the verbose form.
function read(raw, field, scheme) {
  if (scheme !== "Verbose") {
    return json.opcuaJsonDecodeVariant(raw, NO_STRUCTURES, NAMESPACES);
  }
  const typed = { UaType: field.builtInType, Value: raw };
  return json.opcuaJsonDecodeVariant(typed, NO_STRUCTURES, NAMESPACES);
}

function answer(order) {
  const { fields } = json.decodeOPCUA_JSON(DataSetMetaDataType, order.by.MetaData);
  const [{ Payload }] = order.read.Messages;
  return {
    fields: fields.map((field) => {
      const variant = read(Payload[field.name], field, order.scheme);
      return [field.name, DataType[variant.dataType], text(variant)];
    }),
  };
}

console.log(JSON.stringify({ ready: true }));
readline.createInterface({ input: process.stdin }).on("line", (line) => {
  console.log(JSON.stringify(answer(JSON.parse(line))));
});
