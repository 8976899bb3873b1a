"use strict";
// json.js: reads and writes values as JSON by node-opcua-json, the JSON encoding of OPC 10000-6, 5.4. Each line of standard
// input is an order, and is answered by a line:
//   {"read": a ua-data message, "by": its ua-metadata message, "scheme": S}: {"fields": [[name, DataType, text], ..]}
//   {"write": S}: {"payload": {..}}, the values of SAMPLES
// S is Verbose, Compact, DeprecatedReversible or DeprecatedNonReversible. The last is written only, without values whose type
// nobody can know.
const readline = require("readline");
const { DataType, Variant, VariantArrayType } = require("node-opcua-variant");
const { DataValue } = require("node-opcua-data-value");
const { DataSetMetaDataType, DataSetFieldContentMask, EUInformation, Range } = require("node-opcua-types");
const { coerceNodeId, ExpandedNodeId } = require("node-opcua-nodeid");
const { coerceLocalizedText, DiagnosticInfo, QualifiedName } = require("node-opcua-data-model");
const { StatusCodes } = require("node-opcua-status-code");
const json = require("node-opcua-json");

const NAMESPACES = ["http://opcfoundation.org/UA/", "urn:judge"];
const NO_STRUCTURES = { getExtensionObjectConstructor: () => { throw new Error("a structure"); } };

const TIME = new Date(Date.UTC(2026, 0, 2, 3, 4, 5, 678));
const scalar = (dataType, value) => new Variant({ arrayType: VariantArrayType.Scalar, dataType, value });
const array = (dataType, value) => new Variant({ arrayType: VariantArrayType.Array, dataType, value });
const timedOut = () => new DataValue({
  value: scalar(DataType.Double, 1.5), statusCode: StatusCodes.BadTimeout, sourceTimestamp: TIME, sourcePicoseconds: 30,
});
const SAMPLES = {
  truth: scalar(DataType.Boolean, true),
  never: scalar(DataType.Boolean, false),
  least: scalar(DataType.SByte, -128),
  byte: scalar(DataType.Byte, 255),
  short: scalar(DataType.Int16, -3),
  most: scalar(DataType.UInt16, 65535),
  none: scalar(DataType.Int32, 0),
  wide: scalar(DataType.UInt32, 4294967295),
  count: scalar(DataType.Int64, [0x80000000, 0]),
  total: scalar(DataType.UInt64, [0xffffffff, 0xffffffff]),
  half: scalar(DataType.Float, 0.5),
  third: scalar(DataType.Double, 1 / 3),
  broken: scalar(DataType.Double, NaN),
  label: scalar(DataType.String, 'a "b" Ä'),
  time: scalar(DataType.DateTime, TIME),
  never_set: scalar(DataType.DateTime, new Date(Date.UTC(1601, 0, 1))),
  guid: scalar(DataType.Guid, "12345678-1234-5678-9ABC-123456789ABC"),
  blob: scalar(DataType.ByteString, Buffer.from([1, 2, 255])),
  xml: scalar(DataType.XmlElement, "<a/>"),
  node: scalar(DataType.NodeId, coerceNodeId("i=2258")),
  own_node: scalar(DataType.NodeId, coerceNodeId("ns=1;s=x")),
  far_node: scalar(DataType.ExpandedNodeId, new ExpandedNodeId(1, 7, 0, null, 3)),
  status: scalar(DataType.StatusCode, StatusCodes.BadTimeout),
  name: scalar(DataType.QualifiedName, new QualifiedName({ name: "n", namespaceIndex: 1 })),
  text: scalar(DataType.LocalizedText, coerceLocalizedText({ locale: "de", text: "Tür" })),
  range: scalar(DataType.ExtensionObject, new Range({ low: 0, high: 2 })),
  unit: scalar(DataType.ExtensionObject, new EUInformation({ namespaceUri: "urn:u", unitId: 3, displayName: "m" })),
  taken: scalar(DataType.DataValue, timedOut()),
  info: scalar(DataType.DiagnosticInfo, new DiagnosticInfo({ symbolicId: 3, innerStatusCode: StatusCodes.BadTimeout })),
  axes: array(DataType.Float, [0.5, -2.5, NaN]),
  states: array(DataType.StatusCode, [StatusCodes.Good, StatusCodes.BadTimeout]),
  texts: array(DataType.LocalizedText, [coerceLocalizedText({ text: "t" }), coerceLocalizedText({})]),
  mixed: array(DataType.Variant, [
    scalar(DataType.Double, 1.5), scalar(DataType.String, "x"), new Variant({ dataType: DataType.Null }),
  ]),
  grid: new Variant({
    arrayType: VariantArrayType.Matrix, dataType: DataType.Int32, dimensions: [2, 3], value: [1, 2, 3, 4, 5, 6],
  }),
  // A field with a status.
  measured: timedOut(),
};

function write(sample, scheme) {
  if (sample instanceof DataValue) {
    return json.opcuaJsonEncodeDataValueMQTT(sample, scheme, DataSetFieldContentMask.StatusCode, NAMESPACES);
  }
  return json.opcuaJsonEncodeVariant(sample, scheme, NAMESPACES);
}

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
  if (order.write) {
    const scheme = json.JsonEncodingScheme[order.write];
    const isPlain = order.write === "DeprecatedNonReversible";
    const written = Object.entries(SAMPLES).filter(([name]) => !(isPlain && ["mixed", "taken"].includes(name)));
    return { payload: Object.fromEntries(written.map(([name, sample]) => [name, write(sample, scheme)])) };
  }
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
