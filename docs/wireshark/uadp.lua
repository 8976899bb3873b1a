-- Wireshark dissector for UADP over UDP, the binary message mapping of OPC UA PubSub (OPC 10000-14, 7.2.4), with the
-- values in it (OPC 10000-6, 5.2.2). How to install and use it: README.md beside this file.
--
-- What it does not do: decrypt, verify signatures, and read what cannot be read without configuration (RawData,
-- several DataSetMessages without payload header) or is shown as bytes (most discovery bodies).
--
-- No datagram makes it fail: every read goes through a Cursor, which raises a Problem at the byte that is wrong, and
-- every Problem becomes an expert info there. Runs on Lua 5.2 (Wireshark 4.0) and newer.

local uadp = Proto("uadp", "OPC UA PubSub UADP")

uadp.prefs.ports = Pref.range("UDP ports", "4840", "UDP ports whose datagrams are UADP", 65535)
uadp.prefs.heuristic = Pref.bool("Look for UADP on all UDP ports", true,
    "Takes datagrams of other ports that are flawless UADP from PublisherId to the last field")
uadp.prefs.reassemble = Pref.bool("Reassemble chunks", true, "Puts chunked messages together, across frames")
uadp.prefs.max_total = Pref.uint("Largest reassembled message", 16777216, "Bytes; larger ones stay chunks")
uadp.prefs.one_shot_actions = Pref.bool("Actions as UA-.NETStandard has them", false,
    "Requests and responses without DataSetMessage header, their fields as Variants")
uadp.prefs.max_items = Pref.uint("Most items shown of a datagram", 50000,
    "Values behind so many items are read and checked but not shown")

-- Names of numbers

local PUBLISHER_ID_TYPES = { [0] = "Byte", "UInt16", "UInt32", "UInt64", "String" }
local MESSAGE_TYPES = { [0] = "DataSetMessage payload", "discovery probe", "discovery announcement" }
local FIELD_ENCODINGS = { [0] = "Variant", "RawData", "DataValue" }
local KINDS = {
    [0] = "key frame", "delta frame", "event", "keep-alive", [5] = "action request", [6] = "action response",
}
local PROBES = { "Publisher information", "FindApplications" }
local INFORMATION = {
    "Publisher Endpoints", "DataSetMetaData", "DataSetWriter configuration", "WriterGroup configuration",
    "PubSubConnections configuration",
}
local ANNOUNCEMENTS = {
    "Publisher Endpoints", "DataSetMetaData", "DataSetWriter configuration", "PubSubConnection configuration",
    "Application information", "ActionResponder configuration", "ActionMetaData",
}
local APPLICATION_INFORMATION = { "Application description", "Status" }
local BUILTIN = {
    [0] = "null", "Boolean", "SByte", "Byte", "Int16", "UInt16", "Int32", "UInt32", "Int64", "UInt64", "Float",
    "Double", "String", "DateTime", "Guid", "ByteString", "XmlElement", "NodeId", "ExpandedNodeId", "StatusCode",
    "QualifiedName", "LocalizedText", "ExtensionObject", "DataValue", "Variant", "DiagnosticInfo",
}
local NODE_ID_ENCODINGS = { [0] = "two byte", "four byte", "numeric", "String", "Guid", "ByteString" }
local BODIES = { [0] = "no body", "binary", "XML" }
local ACTION_STATES = { [0] = "Idle", "Executing", "Done" }
local KEY_FRAME, DELTA_FRAME, EVENT, KEEP_ALIVE, ACTION_REQUEST, ACTION_RESPONSE = 0, 1, 2, 3, 5, 6
local DATA, PROBE, ANNOUNCEMENT = 0, 1, 2

-- Upper half of StatusCodes (OPC 10000-6, A.2): those that publishers are likely to send.
local STATUS = {
    [0x0000] = "Good", [0x002D] = "GoodSubscriptionTransferred", [0x002E] = "GoodCompletesAsynchronously",
    [0x002F] = "GoodOverload", [0x0030] = "GoodClamped", [0x0096] = "GoodLocalOverride",
    [0x00A2] = "GoodEntryInserted", [0x00A3] = "GoodEntryReplaced", [0x00A5] = "GoodNoData",
    [0x00A6] = "GoodMoreData", [0x4000] = "Uncertain", [0x406C] = "UncertainReferenceOutOfServer",
    [0x408F] = "UncertainNoCommunicationLastUsableValue", [0x4090] = "UncertainLastUsableValue",
    [0x4091] = "UncertainSubstituteValue", [0x4092] = "UncertainInitialValue",
    [0x4093] = "UncertainSensorNotAccurate", [0x4094] = "UncertainEngineeringUnitsExceeded",
    [0x4095] = "UncertainSubNormal", [0x40A4] = "UncertainDataSubNormal",
    [0x40BC] = "UncertainReferenceNotDeleted", [0x40C0] = "UncertainNotAllNodesAvailable",
    [0x8000] = "Bad", [0x8001] = "BadUnexpectedError", [0x8002] = "BadInternalError", [0x8003] = "BadOutOfMemory",
    [0x8004] = "BadResourceUnavailable", [0x8005] = "BadCommunicationError", [0x8006] = "BadEncodingError",
    [0x8007] = "BadDecodingError", [0x8008] = "BadEncodingLimitsExceeded", [0x8009] = "BadUnknownResponse",
    [0x800A] = "BadTimeout", [0x800B] = "BadServiceUnsupported", [0x800C] = "BadShutdown",
    [0x800D] = "BadServerNotConnected", [0x800E] = "BadServerHalted", [0x800F] = "BadNothingToDo",
    [0x8010] = "BadTooManyOperations", [0x8011] = "BadDataTypeIdUnknown", [0x8012] = "BadCertificateInvalid",
    [0x8013] = "BadSecurityChecksFailed", [0x801F] = "BadUserAccessDenied", [0x8023] = "BadInvalidTimestamp",
    [0x8024] = "BadNonceInvalid", [0x8031] = "BadNoCommunication", [0x8032] = "BadWaitingForInitialData",
    [0x8033] = "BadNodeIdInvalid", [0x8034] = "BadNodeIdUnknown", [0x8035] = "BadAttributeIdInvalid",
    [0x8036] = "BadIndexRangeInvalid", [0x8037] = "BadIndexRangeNoData", [0x8038] = "BadDataEncodingInvalid",
    [0x8039] = "BadDataEncodingUnsupported", [0x803A] = "BadNotReadable", [0x803B] = "BadNotWritable",
    [0x803C] = "BadOutOfRange", [0x803D] = "BadNotSupported", [0x803E] = "BadNotFound",
    [0x803F] = "BadObjectDeleted", [0x8040] = "BadNotImplemented", [0x8074] = "BadTypeMismatch",
    [0x8089] = "BadConfigurationError", [0x808A] = "BadNotConnected", [0x808B] = "BadDeviceFailure",
    [0x808C] = "BadSensorFailure", [0x808D] = "BadOutOfService", [0x809B] = "BadNoData",
    [0x809D] = "BadDataLost", [0x809E] = "BadDataUnavailable", [0x80AB] = "BadInvalidArgument",
    [0x80AD] = "BadDisconnect", [0x80AE] = "BadConnectionClosed", [0x80AF] = "BadInvalidState",
    [0x80B1] = "BadNoDataAvailable", [0x80B2] = "BadWaitingForResponse",
}

-- Fields. `F.x_y` is the filter `uadp.x_y`; names with dots are written F["x.y"].

local F = {}

local function field(kind, name, label, ...)
    F[name] = ProtoField[kind]("uadp." .. name, label, ...)
end

-- A byte of flags and its bits: name, label, lowest bit, number of bits, names of the values.
local FLAGS = {}

local function flags(name, label, bits)
    field("uint8", name, label, base.HEX)
    FLAGS[name] = {}
    for _, bit in ipairs(bits) do
        local at, count, names = bit[3], bit[4] or 1, bit[5]
        local mask = (2 ^ count - 1) * 2 ^ at
        if count == 1 and not names then
            field("bool", bit[1], bit[2], 8, nil, mask)
        else
            field("uint8", bit[1], bit[2], base.DEC, names, mask)
        end
        FLAGS[name][#FLAGS[name] + 1] = bit[1]
    end
end

flags("flags", "UADPFlags", {
    { "version", "UADPVersion", 0, 4 },
    { "flags.publisher_id", "PublisherId", 4 },
    { "flags.group_header", "GroupHeader", 5 },
    { "flags.payload_header", "PayloadHeader", 6 },
    { "flags.extended_flags1", "ExtendedFlags1", 7 },
})
flags("extended_flags1", "ExtendedFlags1", {
    { "publisher_id.type", "PublisherId type", 0, 3, PUBLISHER_ID_TYPES },
    { "extended_flags1.data_set_class_id", "DataSetClassId", 3 },
    { "extended_flags1.security", "SecurityHeader", 4 },
    { "extended_flags1.timestamp", "Timestamp", 5 },
    { "extended_flags1.picoseconds", "PicoSeconds", 6 },
    { "extended_flags1.extended_flags2", "ExtendedFlags2", 7 },
})
flags("extended_flags2", "ExtendedFlags2", {
    { "extended_flags2.chunk", "Chunk", 0 },
    { "extended_flags2.promoted_fields", "PromotedFields", 1 },
    { "extended_flags2.message_type", "NetworkMessage type", 2, 3, MESSAGE_TYPES },
    { "extended_flags2.action_header", "ActionHeader", 5 },
    { "extended_flags2.reserved", "Reserved", 6, 2 },
})
field("uint8", "message_type", "NetworkMessage type", base.DEC, MESSAGE_TYPES)
field("uint64", "publisher_id", "PublisherId", base.DEC)
field("string", "publisher_id.string", "PublisherId")
field("guid", "data_set_class_id", "DataSetClassId")

field("none", "group_header", "GroupHeader")
flags("group_flags", "GroupFlags", {
    { "group_flags.writer_group_id", "WriterGroupId", 0 },
    { "group_flags.group_version", "GroupVersion", 1 },
    { "group_flags.network_message_number", "NetworkMessageNumber", 2 },
    { "group_flags.sequence_number", "SequenceNumber", 3 },
    { "group_flags.reserved", "Reserved", 4, 4 },
})
field("uint16", "writer_group_id", "WriterGroupId", base.DEC)
field("uint32", "group_version", "GroupVersion", base.DEC)
field("uint16", "network_message_number", "NetworkMessageNumber", base.DEC)
field("uint16", "sequence_number", "SequenceNumber", base.DEC)

field("none", "payload_header", "PayloadHeader")
field("uint8", "count", "Count", base.DEC)
field("uint16", "dataset_writer_id", "DataSetWriterId", base.DEC)
field("string", "topic", "Topic")

field("absolute_time", "timestamp", "Timestamp", base.UTC)
field("uint16", "picoseconds", "PicoSeconds (10 ps)", base.DEC)
field("none", "promoted_fields", "PromotedFields")
field("uint16", "promoted_fields.size", "Size", base.DEC)

field("none", "security", "SecurityHeader")
flags("security.flags", "SecurityFlags", {
    { "security.signed", "Signed", 0 },
    { "security.encrypted", "Encrypted", 1 },
    { "security.footer_enabled", "SecurityFooter", 2 },
    { "security.force_key_reset", "Force key reset", 3 },
    { "security.reserved", "Reserved", 4, 4 },
})
field("uint32", "security.token_id", "SecurityTokenId", base.DEC)
field("uint8", "security.nonce_length", "NonceLength", base.DEC)
field("bytes", "security.nonce", "MessageNonce")
field("bytes", "security.nonce.random", "Random")
field("uint32", "security.nonce.sequence_number", "SequenceNumber", base.DEC)
field("uint16", "security.footer_size", "SecurityFooterSize", base.DEC)
field("bytes", "security.footer", "SecurityFooter")
field("bytes", "security.signature", "Signature")
field("bytes", "encrypted_payload", "Encrypted payload")

field("none", "action", "ActionHeader")
flags("action.flags", "ActionFlags", {
    { "action.flags.request", "Request", 0 },
    { "action.flags.response_address", "ResponseAddress", 1 },
    { "action.flags.correlation_data", "CorrelationData", 2 },
    { "action.flags.requestor_id", "RequestorId", 3 },
    { "action.flags.timeout_hint", "TimeoutHint", 4 },
    { "action.flags.reserved", "Reserved", 5, 3 },
})
field("string", "action.response_address", "ResponseAddress")
field("bytes", "action.correlation_data", "CorrelationData")
field("uint64", "action.requestor_id", "RequestorId", base.DEC)
field("string", "action.requestor_id.string", "RequestorId")
field("double", "action.timeout_hint", "TimeoutHint (ms)")
field("uint16", "action.target_id", "ActionTargetId", base.DEC)
field("string", "action.target_name", "Name")
field("uint16", "action.request_id", "RequestId", base.DEC)
field("uint8", "action.state", "ActionState", base.DEC, ACTION_STATES)
field("string", "action.method", "ObjectId and MethodId")

field("none", "chunk", "Chunk")
field("uint16", "chunk.message_sequence_number", "MessageSequenceNumber", base.DEC)
field("uint32", "chunk.offset", "ChunkOffset", base.DEC)
field("uint32", "chunk.total_size", "TotalSize", base.DEC)
field("bytes", "chunk.data", "ChunkData")
field("framenum", "chunk.frame", "Chunk in frame", base.NONE, frametype.NONE)
field("framenum", "chunk.reassembled_in", "Reassembled in frame", base.NONE, frametype.NONE)
field("uint32", "chunk.reassembled_length", "Reassembled length", base.DEC)

field("none", "probe", "Discovery probe")
field("uint8", "probe.type", "ProbeType", base.DEC, PROBES)
field("uint8", "probe.information_type", "InformationType", base.DEC, INFORMATION)
field("bytes", "probe.settings", "Settings")
field("none", "announcement", "Discovery announcement")
field("uint8", "announcement.type", "AnnouncementType", base.DEC, ANNOUNCEMENTS)
field("uint16", "announcement.sequence_number", "SequenceNumber", base.DEC)
field("uint16", "announcement.application_information_type", "ApplicationInformationType", base.DEC,
    APPLICATION_INFORMATION)
field("uint32", "announcement.status", "StatusCode", base.HEX)
field("bytes", "announcement.body", "Body")

field("none", "metadata", "DataSetMetaData")
field("string", "metadata.namespace", "Namespace")
field("string", "metadata.data_type", "Described DataType")
field("string", "metadata.name", "Name")
field("string", "metadata.description", "Description")
field("guid", "metadata.data_set_class_id", "DataSetClassId")
field("uint32", "metadata.major_version", "ConfigurationVersion MajorVersion", base.DEC)
field("uint32", "metadata.minor_version", "ConfigurationVersion MinorVersion", base.DEC)
field("none", "metadata.field", "FieldMetaData")
field("string", "metadata.field.name", "Name")
field("string", "metadata.field.description", "Description")
field("uint16", "metadata.field.flags", "FieldFlags", base.HEX)
field("uint8", "metadata.field.builtin_type", "BuiltInType", base.DEC, BUILTIN)
field("string", "metadata.field.data_type", "DataType")
field("int32", "metadata.field.value_rank", "ValueRank", base.DEC)
field("uint32", "metadata.field.array_dimension", "ArrayDimension", base.DEC)
field("uint32", "metadata.field.max_string_length", "MaxStringLength", base.DEC)
field("guid", "metadata.field.id", "DataSetFieldId")
field("string", "metadata.field.property", "Property")

field("uint16", "dataset.size", "Size", base.DEC)
field("none", "dataset", "DataSetMessage")
flags("dataset.flags1", "DataSetFlags1", {
    { "dataset.valid", "Valid", 0 },
    { "dataset.field_encoding", "Field encoding", 1, 2, FIELD_ENCODINGS },
    { "dataset.flags1.sequence_number", "SequenceNumber", 3 },
    { "dataset.flags1.status", "Status", 4 },
    { "dataset.flags1.major_version", "MajorVersion", 5 },
    { "dataset.flags1.minor_version", "MinorVersion", 6 },
    { "dataset.flags1.flags2", "DataSetFlags2", 7 },
})
flags("dataset.flags2", "DataSetFlags2", {
    { "dataset.flags2.type", "DataSetMessage type", 0, 4, KINDS },
    { "dataset.flags2.timestamp", "Timestamp", 4 },
    { "dataset.flags2.picoseconds", "PicoSeconds", 5 },
    { "dataset.flags2.reserved", "Reserved", 6, 2 },
})
field("uint8", "dataset.kind", "Kind", base.DEC, KINDS)
field("uint16", "dataset.sequence_number", "SequenceNumber", base.DEC)
field("absolute_time", "dataset.timestamp", "Timestamp", base.UTC)
field("uint16", "dataset.picoseconds", "PicoSeconds (10 ps)", base.DEC)
field("uint16", "dataset.status", "Status", base.HEX)
field("uint32", "dataset.major_version", "ConfigurationVersion MajorVersion", base.DEC)
field("uint32", "dataset.minor_version", "ConfigurationVersion MinorVersion", base.DEC)
field("uint16", "dataset.field_count", "FieldCount", base.DEC)
field("bytes", "dataset.raw_data", "RawData")
field("bytes", "dataset.padding", "Padding to the ConfiguredSize or to the shortest frame")
field("bytes", "dataset.ignored", "Ignored")

field("none", "field", "Field")
field("uint16", "field.index", "FieldIndex", base.DEC)
flags("field.variant_encoding", "Variant encoding", {
    { "field.type", "Builtin type", 0, 6, BUILTIN },
    { "field.has_dimensions", "ArrayDimensions", 6 },
    { "field.is_array", "Array", 7 },
})
field("int32", "field.array_length", "ArrayLength", base.DEC)
field("int32", "field.dimension", "ArrayDimension", base.DEC)
field("bool", "field.null", "Null")
field("bool", "field.boolean", "Boolean")
field("int8", "field.sbyte", "SByte", base.DEC)
field("uint8", "field.byte", "Byte", base.DEC)
field("int16", "field.int16", "Int16", base.DEC)
field("uint16", "field.uint16", "UInt16", base.DEC)
field("int32", "field.int32", "Int32", base.DEC)
field("uint32", "field.uint32", "UInt32", base.DEC)
field("int64", "field.int64", "Int64", base.DEC)
field("uint64", "field.uint64", "UInt64", base.DEC)
field("float", "field.float", "Float")
field("double", "field.double", "Double")
field("string", "field.string", "String")
field("absolute_time", "field.datetime", "DateTime", base.UTC)
field("guid", "field.guid", "Guid")
field("bytes", "field.bytestring", "ByteString")
field("string", "field.xmlelement", "XmlElement")
field("string", "field.nodeid", "NodeId")
field("string", "field.expandednodeid", "ExpandedNodeId")
field("uint32", "field.statuscode", "StatusCode", base.HEX)
field("string", "field.qualifiedname", "QualifiedName")
field("none", "field.localizedtext", "LocalizedText")
field("string", "field.localizedtext.locale", "Locale")
field("string", "field.localizedtext.text", "Text")
field("none", "field.extensionobject", "ExtensionObject")
field("string", "field.extensionobject.type_id", "TypeId")
field("uint8", "field.extensionobject.encoding", "Encoding", base.DEC, BODIES)
field("bytes", "field.extensionobject.body", "Body")
field("none", "field.datavalue", "DataValue")
flags("field.datavalue.mask", "DataValue encoding mask", {
    { "field.datavalue.has_value", "Value", 0 },
    { "field.datavalue.has_status", "StatusCode", 1 },
    { "field.datavalue.has_source_timestamp", "SourceTimestamp", 2 },
    { "field.datavalue.has_server_timestamp", "ServerTimestamp", 3 },
    { "field.datavalue.has_source_picoseconds", "SourcePicoSeconds", 4 },
    { "field.datavalue.has_server_picoseconds", "ServerPicoSeconds", 5 },
    { "field.datavalue.reserved", "Reserved", 6, 2 },
})
field("uint32", "field.status", "Status", base.HEX)
field("absolute_time", "field.source_timestamp", "SourceTimestamp", base.UTC)
field("uint16", "field.source_picoseconds", "SourcePicoSeconds (10 ps)", base.DEC)
field("absolute_time", "field.server_timestamp", "ServerTimestamp", base.UTC)
field("uint16", "field.server_picoseconds", "ServerPicoSeconds (10 ps)", base.DEC)
field("none", "field.variant", "Variant")
field("none", "field.diagnosticinfo", "DiagnosticInfo")
flags("field.diagnosticinfo.mask", "DiagnosticInfo encoding mask", {
    { "field.diagnosticinfo.has_symbolic_id", "SymbolicId", 0 },
    { "field.diagnosticinfo.has_namespace_uri", "NamespaceUri", 1 },
    { "field.diagnosticinfo.has_localized_text", "LocalizedText", 2 },
    { "field.diagnosticinfo.has_locale", "Locale", 3 },
    { "field.diagnosticinfo.has_additional_info", "AdditionalInfo", 4 },
    { "field.diagnosticinfo.has_inner_status_code", "InnerStatusCode", 5 },
    { "field.diagnosticinfo.has_inner", "InnerDiagnosticInfo", 6 },
    { "field.diagnosticinfo.reserved", "Reserved", 7 },
})
field("int32", "field.diagnosticinfo.symbolic_id", "SymbolicId", base.DEC)
field("int32", "field.diagnosticinfo.namespace_uri", "NamespaceUri", base.DEC)
field("int32", "field.diagnosticinfo.locale", "Locale", base.DEC)
field("int32", "field.diagnosticinfo.localized_text", "LocalizedText", base.DEC)
field("string", "field.diagnosticinfo.additional_info", "AdditionalInfo")
field("uint32", "field.diagnosticinfo.inner_status_code", "InnerStatusCode", base.HEX)
field("bytes", "undissected", "Not dissected")

do
    local all = {}
    for _, one in pairs(F) do
        all[#all + 1] = one
    end
    uadp.fields = all
end

local function expert_info(name, label, group, severity)
    return ProtoExpert.new("uadp." .. name, label, expert.group[group], expert.severity[severity])
end

local E = {
    malformed = expert_info("malformed", "Malformed", "MALFORMED", "ERROR"),
    cut = expert_info("cut_by_capture", "Cut by the capture", "UNDECODED", "WARN"),
    undecoded = expert_info("undecoded", "Not dissected", "UNDECODED", "NOTE"),
    invalid = expert_info("invalid", "DataSetMessage not valid", "SEQUENCE", "NOTE"),
    chunk = expert_info("chunk.not_reassembled", "Chunk not reassembled", "REASSEMBLE", "WARN"),
    hidden = expert_info("hidden", "Too many items", "UNDECODED", "NOTE"),
    bug = expert_info("dissector_bug", "Error in the dissector", "DEBUG", "ERROR"),
}
uadp.experts = { E.malformed, E.cut, E.undecoded, E.invalid, E.chunk, E.hidden, E.bug }

-- Numbers. Lua 5.3 and newer write a whole float as "2.0", which `math.floor` prevents.

local function bit(byte, at)
    return math.floor(byte / 2 ^ at) % 2 == 1
end

local function bits(byte, at, count)
    return math.floor(byte / 2 ^ at) % math.floor(2 ^ count)
end

local function integer(number)
    return string.format("%.0f", number)
end

local function status_name(upper)
    local name = STATUS[upper]
    if name then
        return name
    end
    return ({ [0] = "Good", "Uncertain", "Bad", "Bad" })[math.floor(upper / 0x4000)] .. string.format(" 0x%04X", upper)
end

-- Seconds since 1970 and nanoseconds of a DateTime: 100 ns since 1601 (OPC 10000-6, 5.2.2.5).
local TICKS = Int64.new(10000000)
local FROM_1601 = 11644473600

local function seconds(range)
    local ticks = range:le_int64()
    local whole, rest = (ticks / TICKS):tonumber(), (ticks % TICKS):tonumber()
    if rest < 0 then
        whole, rest = whole - 1, rest + 10000000
    end
    return whole - FROM_1601, rest * 100
end

local function nstime(range)
    return NSTime.new(seconds(range))
end

-- The proleptic Gregorian date of a day counted from 1970.
local function civil(days)
    local from_march = days + 719468
    local era = math.floor(from_march / 146097)
    local day = from_march - era * 146097
    local year = math.floor((day - math.floor(day / 1460) + math.floor(day / 36524) - math.floor(day / 146096)) / 365)
    day = day - (365 * year + math.floor(year / 4) - math.floor(year / 100))
    local month = math.floor((5 * day + 2) / 153)
    day = day - math.floor((153 * month + 2) / 5) + 1
    month = month < 10 and month + 3 or month - 9
    return year + era * 400 + (month <= 2 and 1 or 0), month, day
end

local function iso(range)
    local whole, nanoseconds = seconds(range)
    local days = math.floor(whole / 86400)
    local second = whole - days * 86400
    local year, month, day = civil(days)
    return string.format("%04.0f-%02.0f-%02.0fT%02.0f:%02.0f:%02.0f.%07.0fZ", year, month, day,
        math.floor(second / 3600), math.floor(second / 60) % 60, second % 60, nanoseconds / 100)
end

-- VersionTime: seconds since 2000 (OPC 10000-4, 7.43).
local function version_time(version)
    local year, month, day = civil(math.floor(version / 86400) + 10957)
    return string.format("%04.0f-%02.0f-%02.0fT%02.0f:%02.0f:%02.0fZ", year, month, day,
        math.floor(version / 3600) % 24, math.floor(version / 60) % 60, version % 60)
end

-- Text

local function base64(bytes)
    local digits = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/"
    local out = {}
    for at = 1, #bytes, 3 do
        local a, b, c = bytes:byte(at, at + 2)
        local number = a * 65536 + (b or 0) * 256 + (c or 0)
        for place = 0, 3 do
            local digit = math.floor(number / 64 ^ (3 - place)) % 64
            local padded = (place == 2 and not b) or (place == 3 and not c)
            out[#out + 1] = padded and "=" or digits:sub(digit + 1, digit + 1)
        end
    end
    return table.concat(out)
end

-- Length of the well-formed UTF-8 sequence at `at`, or nil.
local function utf8_length(bytes, at)
    local lead, second = bytes:byte(at, at + 1)
    if lead < 0x80 then
        return 1
    end
    local length = lead >= 0xC2 and lead < 0xE0 and 2 or lead >= 0xE0 and lead < 0xF0 and 3
        or lead >= 0xF0 and lead < 0xF5 and 4
    if not length or at + length - 1 > #bytes then
        return nil
    end
    local low = lead == 0xE0 and 0xA0 or lead == 0xF0 and 0x90 or 0x80
    local high = lead == 0xED and 0x9F or lead == 0xF4 and 0x8F or 0xBF
    if second < low or second > high then
        return nil
    end
    for next = at + 2, at + length - 1 do
        local continuation = bytes:byte(next)
        if continuation < 0x80 or continuation > 0xBF then
            return nil
        end
    end
    return length
end

-- Text to show, and whether it is UTF-8. What would end a C string or is no UTF-8 is replaced by a visible sign.
local function readable(bytes)
    if not bytes:find("[\0\128-\255]") then
        return bytes, true
    end
    local out, at, fine = {}, 1, true
    while at <= #bytes do
        local length = utf8_length(bytes, at)
        if not length then
            out[#out + 1], fine = "\239\191\189", false
        elseif bytes:byte(at) == 0 then
            out[#out + 1] = "\226\144\128"
        else
            out[#out + 1] = bytes:sub(at, at + length - 1)
        end
        at = at + (length or 1)
    end
    return table.concat(out), fine
end

local function shortened(text)
    if #text <= 60 then
        return text
    end
    local cut = 60
    while cut > 0 and text:byte(cut + 1) >= 0x80 and text:byte(cut + 1) < 0xC0 do
        cut = cut - 1
    end
    return text:sub(1, cut) .. "..."
end

-- Cursor: reads left to right and never past `stop`. What is wrong is raised as a Problem: { at, length, text, cut }.

local Cursor = {}
Cursor.__index = Cursor

local function cursor(tvb, pos, stop)
    return setmetatable({ tvb = tvb, pos = pos, stop = stop }, Cursor)
end

function Cursor:problem(at, length, text)
    error({ tvb = self.tvb, at = at, length = length, text = text }, 0)
end

function Cursor:left()
    return self.stop - self.pos
end

-- The next `length` bytes, unread. Where the capture has not got them that is not the sender's fault.
function Cursor:peek(length, what)
    local left = self:left()
    if length > left then
        self:problem(self.pos, left,
            string.format("%s is cut off: %s bytes expected, %d left", what, integer(length), left))
    end
    local captured = self.tvb:len()
    if self.pos + length > captured then
        error({ tvb = self.tvb, at = self.pos, length = math.max(captured - self.pos, 0), cut = true,
            text = what .. " is not in the capture" }, 0)
    end
    return self.tvb:range(self.pos, length)
end

function Cursor:take(length, what)
    local range = self:peek(length, what)
    self.pos = self.pos + length
    return range
end

function Cursor:rest(what)
    return self:take(self:left(), what)
end

-- A cursor for the next `length` bytes, which are skipped here. The first byte alone has to be in the capture.
function Cursor:sub(length, what)
    if length > self:left() then
        self:peek(length, what)
    end
    local inner = cursor(self.tvb, self.pos, self.pos + length)
    self.pos = self.pos + length
    return inner
end

-- Int32 length of `what`, nil for -1 (null).
function Cursor:length(what)
    local range = self:take(4, "length of " .. what)
    local length = math.floor(range:le_int())
    if length < -1 then
        self:problem(self.pos - 4, 4, string.format("length of %s is %d", what, length))
    end
    return length >= 0 and length or nil, range
end

-- A length of elements that take at least `least` bytes each.
function Cursor:count(what, least)
    local count, range = self:length(what)
    if count and count * least > self:left() then
        self:problem(self.pos - 4, 4,
            string.format("%s of length %d does not fit in the %d bytes left", what, count, self:left()))
    end
    return count, range
end

-- Bytes behind an Int32 length, nil for null; and the range with the length.
function Cursor:byte_string(what)
    local at = self.pos
    local length = self:length(what)
    local range = length and self:take(length, what)
    return range, self.tvb:range(at, self.pos - at)
end

-- The tree. `ctx` is one datagram's dissection: what was found wrong, what the Info column says, items left to show.
-- In a trial (`ctx.trial`) nothing is shown. A nil tree shows nothing either. `ctx.prefix` goes before the next item.

local function put(ctx, tree, name, range, value)
    if not tree then
        return nil
    end
    if ctx.items == 0 then
        ctx.hidden = ctx.hidden + 1
        return nil
    end
    ctx.items = ctx.items - 1
    local item
    if value == nil then
        item = tree:add_le(F[name], range)
    elseif range == nil then
        item = tree:add(F[name], value):set_generated()
    else
        item = tree:add(F[name], range, value)
    end
    if ctx.prefix then
        item:prepend_text(ctx.prefix)
        ctx.prefix = nil
    end
    return item
end

-- The bytes from `from` up to `to` as far as the capture has them.
local function captured(tvb, from, to)
    local stop = tvb:len()
    local start = math.min(from, stop)
    return tvb:range(start, math.max(math.min(to, stop) - start, 0))
end

-- An item that spans what `read` reads; as long as that has no end, all that is left. Gives what `read` gives.
local function within(ctx, tree, name, cur, read)
    local start = cur.pos
    local item = put(ctx, tree, name, captured(cur.tvb, start, cur.stop))
    local text = read(item)
    if item then
        item:set_len(cur.pos - start)
        if text then
            item:append_text(": " .. text)
        end
    end
    return text
end

local function say(item, text)
    if item and text then
        item:append_text(text)
    end
end

local function report(ctx, tree, kind, problem)
    if problem.cut then
        kind = E.cut
    elseif kind == E.malformed and ctx.invalid then
        -- Nothing behind a cleared valid bit is promised to mean anything, so nothing there is malformed.
        kind = E.undecoded
    end
    if kind == E.malformed then
        ctx.malformed = ctx.malformed or problem
    end
    -- Told even where the items it would stand under are too many to be shown.
    tree = tree or ctx.root
    if not tree then
        return
    end
    local tvb, at, length = problem.tvb, problem.at, problem.length
    -- Where nothing is left, the last byte there is stands for the missing ones.
    if length <= 0 and at > 0 then
        at, length = at - 1, 1
    end
    local place = tvb == ctx.datagram and "" or " of the reassembled message"
    tree:add_tvb_expert_info(kind, captured(tvb, at, at + length),
        string.format("At byte %d%s: %s", problem.at, place, problem.text))
end

local function note(ctx, tree, kind, cur, at, length, text)
    report(ctx, tree, kind, { tvb = cur.tvb, at = at, length = length, text = text })
end

-- Runs `read`; a Problem in it is reported at `tree`, and the bytes not read go under `leftover`.
local function guarded(ctx, tree, cur, read, leftover)
    local fine, problem = pcall(read)
    if fine then
        return true
    end
    if type(problem) ~= "table" then
        error(problem, 0)
    end
    ctx.prefix = nil
    report(ctx, tree, E.malformed, problem)
    local rest = captured(cur.tvb, cur.pos, cur.stop)
    if rest:len() > 0 then
        put(ctx, tree, leftover or "undissected", rest)
    end
    return false
end

local function put_flags(ctx, tree, name, range)
    local item = put(ctx, tree, name, range)
    for _, each in ipairs(FLAGS[name]) do
        put(ctx, item, each, range)
    end
    return math.floor(range:uint())
end

-- Small readers: each takes what it reads, shows it, and gives the value.

local function u8(ctx, cur, tree, name, what)
    local range = cur:take(1, what)
    return math.floor(range:uint()), put(ctx, tree, name, range)
end

local function u16(ctx, cur, tree, name, what)
    local range = cur:take(2, what)
    return math.floor(range:le_uint()), put(ctx, tree, name, range)
end

local function u32(ctx, cur, tree, name, what)
    local range = cur:take(4, what)
    return math.floor(range:le_uint()), put(ctx, tree, name, range)
end

local function i32(ctx, cur, tree, name, what)
    local range = cur:take(4, what)
    return math.floor(range:le_int()), put(ctx, tree, name, range)
end

local function datetime(ctx, cur, tree, name, what)
    local range = cur:take(8, what)
    put(ctx, tree, name, range, nstime(range))
    return iso(range)
end

local function guid(ctx, cur, tree, name, what)
    put(ctx, tree, name, cur:take(16, what))
end

local function version(ctx, cur, tree, name, what)
    local value, item = u32(ctx, cur, tree, name, what)
    say(item, " (" .. version_time(value) .. ")")
end

local function status_code(ctx, cur, tree, name, what)
    local value, item = u32(ctx, cur, tree, name, what)
    local text = status_name(math.floor(value / 65536))
    say(item, " (" .. text .. ")")
    return text
end

-- A String; nil for null, which gets its own item so that it is not taken for the empty one.
local function text(ctx, cur, tree, name, what)
    local at = cur.pos
    local range, all = cur:byte_string(what)
    if not range then
        say(put(ctx, tree, "field.null", all, true), " (" .. what .. ")")
        return nil
    end
    local shown, fine = readable(range:raw())
    put(ctx, tree, name, all, shown)
    if not fine then
        note(ctx, tree, E.malformed, cur, at + 4, range:len(), what .. " is not UTF-8")
    end
    return shown
end

-- Values (OPC 10000-6, 5.2.2). VALUE[builtin type](ctx, cur, tree, depth) shows one and gives a short text of it.

local VALUE = {}
-- Fewest bytes a value takes, for counts of elements.
local LEAST = {
    1, 1, 1, 2, 2, 4, 4, 8, 8, 4, 8, 4, 8, 16, 4, 4, 2, 2, 4, 6, 1, 3, 1, 1, 1,
}
-- Levels of values in values: the 100 of version 1.04 (OPC 10000-6, 5.2.2.12 and 5.2.2.16). A receiver may stop sooner,
-- 1.05 expects 10, but what it refuses is worth seeing.
local DEPTH = 100

local function number(builtin, size, name, show)
    VALUE[builtin] = function(ctx, cur, tree)
        local range = cur:take(size, BUILTIN[builtin])
        put(ctx, tree, name, range)
        return show(range)
    end
end

local function decimal(value)
    return (string.format("%.15g", value):gsub("^%-?nan$", "NaN"))
end

number(1, 1, "field.boolean", function(range) return range:uint() ~= 0 and "true" or "false" end)
number(2, 1, "field.sbyte", function(range) return integer(range:le_int()) end)
number(3, 1, "field.byte", function(range) return integer(range:le_uint()) end)
number(4, 2, "field.int16", function(range) return integer(range:le_int()) end)
number(5, 2, "field.uint16", function(range) return integer(range:le_uint()) end)
number(6, 4, "field.int32", function(range) return integer(range:le_int()) end)
number(7, 4, "field.uint32", function(range) return integer(range:le_uint()) end)
number(8, 8, "field.int64", function(range) return tostring(range:le_int64()) end)
number(9, 8, "field.uint64", function(range) return tostring(range:le_uint64()) end)
number(10, 4, "field.float", function(range) return (decimal(range:le_float()):gsub("(%.%d%d%d%d%d%d)%d+", "%1")) end)
number(11, 8, "field.double", function(range) return decimal(range:le_float()) end)

VALUE[12] = function(ctx, cur, tree)
    local value = text(ctx, cur, tree, "field.string", "String")
    return value and '"' .. shortened(value) .. '"' or "null"
end

VALUE[13] = function(ctx, cur, tree)
    return datetime(ctx, cur, tree, "field.datetime", "DateTime")
end

local function guid_text(range)
    return string.format("%08x-%04x-%04x-%s-%s", range(0, 4):le_uint(), range(4, 2):le_uint(), range(6, 2):le_uint(),
        tostring(range(8, 2):bytes()):lower(), tostring(range(10, 6):bytes()):lower())
end

VALUE[14] = function(ctx, cur, tree)
    local range = cur:take(16, "Guid")
    put(ctx, tree, "field.guid", range)
    return guid_text(range)
end

VALUE[15] = function(ctx, cur, tree)
    local range, all = cur:byte_string("ByteString")
    if not range then
        say(put(ctx, tree, "field.null", all, true), " (ByteString)")
        return "null"
    end
    put(ctx, tree, "field.bytestring", range)
    return range:len() .. " bytes"
end

VALUE[16] = function(ctx, cur, tree)
    local value = text(ctx, cur, tree, "field.xmlelement", "XmlElement")
    return value and shortened(value) or "null"
end

-- NodeIds are shown in the text form of OPC 10000-6, 5.1.12: "ns=2;s=Robot".
local IDENTIFIER = {
    [0] = function(cur) return 0, "i=" .. integer(cur:take(1, "NodeId"):uint()) end,
    function(cur)
        local namespace = cur:take(1, "NodeId"):uint()
        return namespace, "i=" .. integer(cur:take(2, "NodeId"):le_uint())
    end,
    function(cur)
        local namespace = cur:take(2, "NodeId"):le_uint()
        return namespace, "i=" .. integer(cur:take(4, "NodeId"):le_uint())
    end,
    function(cur)
        local namespace = cur:take(2, "NodeId"):le_uint()
        local at = cur.pos
        local range = cur:byte_string("NodeId String")
        local shown, fine = readable(range and range:raw() or "")
        if not fine then
            cur:problem(at + 4, range:len(), "NodeId String is not UTF-8")
        end
        return namespace, "s=" .. shown
    end,
    function(cur)
        local namespace = cur:take(2, "NodeId"):le_uint()
        return namespace, "g=" .. guid_text(cur:take(16, "NodeId Guid"))
    end,
    function(cur)
        local namespace = cur:take(2, "NodeId"):le_uint()
        local range = cur:byte_string("NodeId ByteString")
        return namespace, "b=" .. base64(range and range:raw() or "")
    end,
}

-- Namespace index, identifier as text, and the flags beside the encoding.
local function read_node_id(cur, flags_allowed)
    local encoding = math.floor(cur:take(1, "NodeId"):uint())
    local form, extra = encoding % 64, encoding - encoding % 64
    if not IDENTIFIER[form] or (extra ~= 0 and not flags_allowed) then
        cur:problem(cur.pos - 1, 1, string.format("NodeId encoding 0x%02x is reserved", encoding))
    end
    local namespace, identifier = IDENTIFIER[form](cur)
    return namespace, identifier, extra
end

local function node_id(ctx, cur, tree, name)
    local at = cur.pos
    local namespace, identifier = read_node_id(cur, false)
    local shown = namespace == 0 and identifier or string.format("ns=%d;%s", namespace, identifier)
    put(ctx, tree, name, cur.tvb:range(at, cur.pos - at), shown)
    return shown
end

VALUE[17] = function(ctx, cur, tree)
    return node_id(ctx, cur, tree, "field.nodeid")
end

VALUE[18] = function(ctx, cur, tree)
    local at = cur.pos
    local namespace, identifier, extra = read_node_id(cur, true)
    local shown = namespace == 0 and identifier or string.format("ns=%d;%s", namespace, identifier)
    if extra >= 128 then
        local uri_at = cur.pos + 4
        local range = cur:byte_string("NamespaceUri")
        local uri, fine = readable(range and range:raw() or "")
        if not fine then
            note(ctx, tree, E.malformed, cur, uri_at, range:len(), "NamespaceUri is not UTF-8")
        end
        shown = string.format("nsu=%s;%s", uri, identifier)
    end
    if extra % 128 >= 64 then
        shown = string.format("svr=%s;%s", integer(cur:take(4, "ServerIndex"):le_uint()), shown)
    end
    put(ctx, tree, "field.expandednodeid", cur.tvb:range(at, cur.pos - at), shown)
    return shown
end

VALUE[19] = function(ctx, cur, tree)
    return status_code(ctx, cur, tree, "field.statuscode", "StatusCode")
end

local function qualified_name(ctx, cur, tree, name)
    local at = cur.pos
    local namespace = cur:take(2, "QualifiedName NamespaceIndex"):le_uint()
    local range = cur:byte_string("QualifiedName Name")
    local shown, fine = readable(range and range:raw() or "")
    local all = integer(namespace) .. ":" .. shown
    put(ctx, tree, name, cur.tvb:range(at, cur.pos - at), all)
    if not fine then
        note(ctx, tree, E.malformed, cur, at + 6, range:len(), "QualifiedName Name is not UTF-8")
    end
    return all
end

VALUE[20] = function(ctx, cur, tree)
    return qualified_name(ctx, cur, tree, "field.qualifiedname")
end

-- The two parts, nil for one left out. The locale is shown where its field is named.
local function localized_text(ctx, cur, tree, locale_name, text_name)
    local mask = math.floor(cur:take(1, "LocalizedText"):uint())
    if mask > 3 then
        cur:problem(cur.pos - 1, 1, string.format("LocalizedText encoding mask 0x%02x is reserved", mask))
    end
    local locale = bit(mask, 0) and text(ctx, cur, locale_name and tree, locale_name, "Locale") or nil
    local shown = bit(mask, 1) and text(ctx, cur, tree, text_name, "Text") or nil
    return locale, shown
end

VALUE[21] = function(ctx, cur, tree)
    return within(ctx, tree, "field.localizedtext", cur, function(item)
        local _, shown = localized_text(ctx, cur, item, "field.localizedtext.locale", "field.localizedtext.text")
        return shown and '"' .. shortened(shown) .. '"' or "null"
    end)
end

VALUE[22] = function(ctx, cur, tree)
    return within(ctx, tree, "field.extensionobject", cur, function(item)
        local type_id = node_id(ctx, cur, item, "field.extensionobject.type_id")
        local encoding = u8(ctx, cur, item, "field.extensionobject.encoding", "ExtensionObject encoding")
        if encoding > 2 then
            cur:problem(cur.pos - 1, 1, string.format("ExtensionObject encoding %d is reserved", encoding))
        elseif encoding == 0 then
            return type_id .. " without body"
        end
        local body, all = cur:byte_string("ExtensionObject body")
        if not body then
            say(put(ctx, item, "field.null", all, true), " (ExtensionObject body)")
            return type_id .. ", null body"
        end
        put(ctx, item, "field.extensionobject.body", body)
        return string.format("%s, %d bytes", type_id, body:len())
    end)
end

local function inner(cur, depth)
    if depth <= 0 then
        cur:problem(cur.pos, 1, "values nested deeper than " .. DEPTH .. " levels")
    end
    return depth - 1
end

local read_variant

-- The parts of a DataValue behind each other; times and picoseconds of one clock stand together.
local function read_data_value(ctx, cur, tree, depth)
    local mask = put_flags(ctx, tree, "field.datavalue.mask", cur:take(1, "DataValue encoding mask"))
    if mask > 0x3F then
        cur:problem(cur.pos - 1, 1, string.format("DataValue encoding mask 0x%02x is reserved", mask))
    end
    local shown = bit(mask, 0) and read_variant(ctx, cur, tree, depth) or "no value"
    if bit(mask, 1) then
        shown = shown .. ", " .. status_code(ctx, cur, tree, "field.status", "Status")
    end
    if bit(mask, 2) then
        datetime(ctx, cur, tree, "field.source_timestamp", "SourceTimestamp")
    end
    if bit(mask, 4) then
        u16(ctx, cur, tree, "field.source_picoseconds", "SourcePicoSeconds")
    end
    if bit(mask, 3) then
        datetime(ctx, cur, tree, "field.server_timestamp", "ServerTimestamp")
    end
    if bit(mask, 5) then
        u16(ctx, cur, tree, "field.server_picoseconds", "ServerPicoSeconds")
    end
    return shown
end

VALUE[23] = function(ctx, cur, tree, depth)
    local deeper = inner(cur, depth)
    return within(ctx, tree, "field.datavalue", cur, function(item)
        return read_data_value(ctx, cur, item, deeper)
    end)
end

VALUE[24] = function(ctx, cur, tree, depth)
    local deeper = inner(cur, depth)
    return within(ctx, tree, "field.variant", cur, function(item)
        return read_variant(ctx, cur, item, deeper)
    end)
end

-- Not in the order of their bits (OPC 10000-6, 5.2.2.12).
local DIAGNOSTIC_INDEXES = {
    { 0, "symbolic_id" }, { 1, "namespace_uri" }, { 3, "locale" }, { 2, "localized_text" },
}

VALUE[25] = function(ctx, cur, tree, depth)
    local deeper = inner(cur, depth)
    local name = "field.diagnosticinfo"
    return within(ctx, tree, name, cur, function(item)
        local mask = put_flags(ctx, item, name .. ".mask", cur:take(1, "DiagnosticInfo encoding mask"))
        if mask > 0x7F then
            cur:problem(cur.pos - 1, 1, string.format("DiagnosticInfo encoding mask 0x%02x is reserved", mask))
        end
        for _, index in ipairs(DIAGNOSTIC_INDEXES) do
            if bit(mask, index[1]) then
                i32(ctx, cur, item, name .. "." .. index[2], "DiagnosticInfo " .. index[2])
            end
        end
        if bit(mask, 4) then
            text(ctx, cur, item, name .. ".additional_info", "AdditionalInfo")
        end
        if bit(mask, 5) then
            status_code(ctx, cur, item, name .. ".inner_status_code", "InnerStatusCode")
        end
        if bit(mask, 6) then
            VALUE[25](ctx, cur, item, deeper)
        end
        return string.format("mask 0x%02x", mask)
    end)
end

local function read_array(ctx, cur, tree, builtin, depth)
    local count, range = cur:count(BUILTIN[builtin] .. " array", LEAST[builtin])
    put(ctx, tree, "field.array_length", range)
    if not count then
        put(ctx, tree, "field.null", range, true)
        return nil, "null array"
    end
    local shown = {}
    for index = 1, count do
        ctx.prefix = tree and string.format("[%d] ", index - 1)
        local value = VALUE[builtin](ctx, cur, tree, depth)
        if index <= 4 then
            shown[index] = value
        end
    end
    ctx.prefix = nil
    if count > 4 then
        shown[5] = "..."
    end
    return count, string.format("[%s]", table.concat(shown, ", "))
end

local function read_dimensions(ctx, cur, tree, elements)
    local at = cur.pos
    local count = cur:count("ArrayDimensions", 4) or 0
    local product, sizes = 1.0, {}
    for index = 1, count do
        sizes[index] = i32(ctx, cur, tree, "field.dimension", "ArrayDimension")
        product = sizes[index] < 0 and math.huge or product * sizes[index]
    end
    local nothing = count == 0 and (elements or 0) == 0
    if product ~= (elements or 0) and not nothing then
        note(ctx, tree, E.malformed, cur, at, cur.pos - at,
            string.format("ArrayDimensions do not fit the %d elements", elements or 0))
    end
    return table.concat(sizes, "x")
end

-- Value, array or matrix behind the byte that says which and of what.
local function read_typed(ctx, cur, tree, encoding, depth)
    local builtin = encoding % 64
    local at = cur.pos - 1
    if builtin > 25 and builtin < 32 then
        note(ctx, tree, E.undecoded, cur, at, 1, "builtin type " .. builtin .. " is unassigned and read as ByteString")
        builtin = 15
    end
    if not bit(encoding, 7) then
        if builtin == 24 then
            cur:problem(at, 1, "a Variant directly in a Variant")
        end
        return VALUE[builtin](ctx, cur, tree, depth)
    end
    local count, shown = read_array(ctx, cur, tree, builtin, depth)
    if bit(encoding, 6) then
        shown = read_dimensions(ctx, cur, tree, count) .. " " .. shown
    end
    return shown
end

function read_variant(ctx, cur, tree, depth)
    local range = cur:take(1, "Variant")
    local encoding = put_flags(ctx, tree, "field.variant_encoding", range)
    if encoding == 0 then
        put(ctx, tree, "field.null", range, true)
        return "null"
    end
    local builtin = encoding % 64
    local dimensions_of_scalar = bit(encoding, 6) and not bit(encoding, 7)
    if builtin == 0 or builtin > 31 or dimensions_of_scalar then
        cur:problem(cur.pos - 1, 1, string.format("Variant encoding 0x%02x is reserved", encoding))
    end
    local name = (BUILTIN[builtin] or "type " .. builtin) .. (bit(encoding, 7) and "[]" or "")
    return name .. " " .. read_typed(ctx, cur, tree, encoding, depth)
end

-- DataSetMessages (OPC 10000-14, 7.2.4.5)

local function read_fields(ctx, cur, tree, kind, encoding)
    local at = cur.pos
    local count = u16(ctx, cur, tree, "dataset.field_count", "FieldCount")
    if count > cur:left() then
        cur:problem(at, 2, string.format("FieldCount %d does not fit in the %d bytes left", count, cur:left()))
    end
    for number = 0, count - 1 do
        within(ctx, tree, "field", cur, function(item)
            local index = number
            if kind == DELTA_FRAME then
                index = u16(ctx, cur, item, "field.index", "FieldIndex")
            else
                put(ctx, item, "field.index", nil, number)
            end
            say(item, " " .. index)
            local read = encoding == 2 and read_data_value or read_variant
            return read(ctx, cur, item, DEPTH)
        end)
    end
    return count
end

-- Behind the end of a message stand zeros up to the ConfiguredSize, or nothing (OPC 10000-14, 6.3.1.3.3).
local function read_padding(ctx, cur, tree, sized)
    local left = cur:left()
    if left == 0 then
        return
    end
    local range = cur:rest("Padding")
    if range:raw():find("[^\0]") then
        if sized then
            cur:problem(cur.pos - left, left, left .. " bytes behind the end of the message")
        end
        put(ctx, tree, "undissected", range)
        note(ctx, tree, E.undecoded, cur, cur.pos - left, left,
            "without payload header only the configuration says what follows the first DataSetMessage")
        return
    end
    put(ctx, tree, "dataset.padding", range)
end

-- A short Ethernet frame ends with zeros.
local function read_frame_padding(ctx, cur, tree, what)
    local left = cur:left()
    if left == 0 then
        return
    end
    local range = cur:rest("Padding")
    if range:raw():find("[^\0]") then
        cur:problem(cur.pos - left, left, left .. " bytes behind " .. what)
    end
    put(ctx, tree, "dataset.padding", range)
end

local function count_of_fields(count)
    return count == 1 and " (1 field)" or string.format(" (%d fields)", count)
end

-- Actions (OPC 10000-14, 7.2.4.5.9 and 7.2.4.5.10): "4660 of target 7, Executing (2 fields)".
local function read_action(ctx, cur, tree, head, sized)
    local target = u16(ctx, cur, tree, "action.target_id", "ActionTargetId")
    local request = u16(ctx, cur, tree, "action.request_id", "RequestId")
    local state = u8(ctx, cur, tree, "action.state", "ActionState")
    if not ACTION_STATES[state] then
        cur:problem(cur.pos - 1, 1, "ActionState " .. state .. " is reserved")
    end
    local words = string.format(" %d of target %d, %s", request, target, ACTION_STATES[state])
    if head.encoding == 1 then
        local count = u16(ctx, cur, tree, "dataset.field_count", "FieldCount")
        put(ctx, tree, "dataset.raw_data", cur:rest("RawData"))
        return words .. count_of_fields(count)
    end
    local count = read_fields(ctx, cur, tree, head.kind, head.encoding)
    read_padding(ctx, cur, tree, sized)
    return words .. count_of_fields(count)
end

local function read_payload(ctx, cur, tree, head, sized)
    if not KINDS[head.kind] then
        cur:problem(head.at + 1, 1, string.format("DataSetMessage type %d is reserved", head.kind))
    elseif ctx.action and head.kind ~= ctx.action then
        cur:problem(head.at, 2, string.format("a %s under the ActionHeader of an %s", KINDS[head.kind],
            KINDS[ctx.action]))
    elseif head.kind > KEEP_ALIVE then
        if not ctx.action then
            cur:problem(head.at, 2, KINDS[head.kind] .. " without ActionHeader")
        elseif head.encoding == 2 then
            cur:problem(head.at, 1, "DataValues in an Action")
        end
        return read_action(ctx, cur, tree, head, sized)
    elseif head.kind == KEEP_ALIVE then
        read_padding(ctx, cur, tree, sized)
        return ""
    elseif head.encoding == 1 then
        local at, left = cur.pos, cur:left()
        put(ctx, tree, "dataset.raw_data", cur:rest("RawData"))
        if head.kind ~= KEY_FRAME then
            note(ctx, tree, E.malformed, cur, head.at, 1, "RawData in a " .. KINDS[head.kind])
        end
        return string.format(" (%d bytes RawData)", left), at
    elseif head.kind == KEY_FRAME and cur:left() == 0 then
        return " (0 fields)"
    end
    local count = read_fields(ctx, cur, tree, head.kind, head.encoding)
    read_padding(ctx, cur, tree, sized)
    return count_of_fields(count)
end

local function read_dataset_header(ctx, cur, tree, head)
    local flags1 = put_flags(ctx, tree, "dataset.flags1", cur:take(1, "DataSetFlags1"))
    head.valid = bit(flags1, 0)
    head.encoding = bits(flags1, 1, 2)
    local flags2 = bit(flags1, 7) and put_flags(ctx, tree, "dataset.flags2", cur:take(1, "DataSetFlags2")) or 0
    if head.encoding == 3 then
        cur:problem(head.at, 1, "field encoding 3 is reserved")
    end
    head.kind = flags2 % 16
    put(ctx, tree, "dataset.kind", nil, head.kind)
    if flags2 >= 64 then
        cur:problem(head.at + 1, 1, string.format("DataSetFlags2 0x%02x has reserved bits", flags2))
    end
    if bit(flags1, 3) then
        head.sequence_number = u16(ctx, cur, tree, "dataset.sequence_number", "DataSetMessageSequenceNumber")
    end
    if bit(flags2, 4) then
        datetime(ctx, cur, tree, "dataset.timestamp", "Timestamp")
    end
    if bit(flags2, 5) then
        u16(ctx, cur, tree, "dataset.picoseconds", "PicoSeconds")
    end
    if bit(flags1, 4) then
        local status, item = u16(ctx, cur, tree, "dataset.status", "Status")
        say(item, " (" .. status_name(status) .. ")")
    end
    if bit(flags1, 5) then
        version(ctx, cur, tree, "dataset.major_version", "MajorVersion")
    end
    if bit(flags1, 6) then
        version(ctx, cur, tree, "dataset.minor_version", "MinorVersion")
    end
end

-- What the Info column says of a message: "10 key frame seq 3 (2 fields)".
local function summary(head, payload)
    local words = KINDS[head.kind] or "type " .. head.kind
    if head.sequence_number then
        words = words .. " seq " .. head.sequence_number
    end
    return words .. payload
end

-- The one message that fills `cur`. `sized`: its end is known, so what follows its fields is padding or wrong.
local function dissect_dataset_message(ctx, cur, tree, writer_id, sized)
    local start = cur.pos
    local item = put(ctx, tree, "dataset", captured(cur.tvb, start, cur.stop))
    local head = { at = start, valid = true, kind = KEY_FRAME, encoding = 0 }
    local payload = ""
    if writer_id then
        say(item, " of DataSetWriterId " .. writer_id)
    end
    local one_shot = ctx.action and uadp.prefs.one_shot_actions
    local flags = captured(cur.tvb, start, math.min(start + 1, cur.stop))
    ctx.invalid = not one_shot and flags:len() == 1 and not bit(flags:uint(), 0)
    if ctx.invalid then
        note(ctx, item, E.invalid, cur, start, 1, "the valid bit is cleared, receivers skip this DataSetMessage")
    end
    guarded(ctx, item, cur, function()
        if one_shot then
            head.kind = ctx.action
            put(ctx, item, "dataset.kind", nil, head.kind)
        else
            read_dataset_header(ctx, cur, item, head)
        end
        payload = read_payload(ctx, cur, item, head, sized)
    end, ctx.invalid and "dataset.ignored" or nil)
    ctx.invalid = false
    local words = summary(head, payload) .. (head.valid and "" or ", not valid")
    say(item, ": " .. words)
    ctx.info[#ctx.info + 1] = (writer_id and writer_id .. " " or "") .. words
end

local function dissect_dataset_messages(ctx, cur, tree, writer_ids)
    if #writer_ids <= 1 then
        dissect_dataset_message(ctx, cur, tree, writer_ids[1], #writer_ids == 1)
        return
    end
    local sizes = {}
    for number = 1, #writer_ids do
        local size, item = u16(ctx, cur, tree, "dataset.size", "Sizes")
        say(item, " (DataSetWriterId " .. writer_ids[number] .. ")")
        sizes[number] = size
    end
    for number, size in ipairs(sizes) do
        local what = "DataSetMessage of DataSetWriterId " .. writer_ids[number]
        dissect_dataset_message(ctx, cur:sub(size, what), tree, writer_ids[number], true)
    end
    read_frame_padding(ctx, cur, tree, "the last DataSetMessage")
end

-- Discovery (OPC 10000-14, 7.2.4.6)

local function read_writer_ids(ctx, cur, tree)
    local count = cur:count("DataSetWriterIds", 2) or 0
    local ids = {}
    for index = 1, count do
        ids[index] = u16(ctx, cur, tree, "dataset_writer_id", "DataSetWriterId")
    end
    return table.concat(ids, ", ")
end

local function read_probe(ctx, cur, tree)
    local probe = u8(ctx, cur, tree, "probe.type", "ProbeType")
    if not PROBES[probe] then
        cur:problem(cur.pos - 1, 1, "ProbeType " .. probe .. " is reserved")
    elseif probe == 2 then
        return PROBES[2]
    end
    local information = u8(ctx, cur, tree, "probe.information_type", "InformationType")
    local name = INFORMATION[information]
    if not name then
        cur:problem(cur.pos - 1, 1, "InformationType " .. information .. " is reserved")
    elseif information == 2 or information == 3 then
        return name .. " of " .. read_writer_ids(ctx, cur, tree)
    elseif information == 1 and cur:left() == 4 then
        -- Version 1.04 has the null array of ids here.
        read_writer_ids(ctx, cur, tree)
    elseif information > 3 and cur:left() > 0 then
        put(ctx, tree, "probe.settings", cur:rest("Settings"))
    end
    return name
end

local function dissect_probe(ctx, cur, tree)
    within(ctx, tree, "probe", cur, function(item)
        guarded(ctx, item, cur, function()
            local words = read_probe(ctx, cur, item)
            say(item, ": " .. words)
            ctx.info[#ctx.info + 1] = "probe for " .. words
            read_frame_padding(ctx, cur, item, "the probe")
        end)
    end)
end

local function each(ctx, cur, what, least, read)
    for _ = 1, cur:count(what, least) or 0 do
        read(ctx, cur)
    end
end

local function skip_localized_text(ctx, cur)
    localized_text(ctx, cur, nil)
end

-- StructureField, OPC 10000-3, 8.51.
local function skip_structure_field(ctx, cur)
    text(ctx, cur, nil, nil, "Name")
    skip_localized_text(ctx, cur)
    read_node_id(cur, false)
    cur:take(4, "ValueRank")
    cur:take(4 * (cur:count("ArrayDimensions", 4) or 0), "ArrayDimensions")
    cur:take(5, "MaxStringLength and IsOptional")
end

-- EnumField, OPC 10000-3, 8.52.
local function skip_enum_field(ctx, cur)
    cur:take(8, "Value")
    skip_localized_text(ctx, cur)
    skip_localized_text(ctx, cur)
    text(ctx, cur, nil, nil, "Name")
end

-- Descriptions of DataTypes stand before the metadata (DataTypeSchemaHeader, OPC 10000-5); only their names are shown.
local function read_schema(ctx, cur, tree)
    each(ctx, cur, "Namespaces", 4, function()
        text(ctx, cur, tree, "metadata.namespace", "Namespace")
    end)
    local function described(read)
        return function()
            read_node_id(cur, false)
            qualified_name(ctx, cur, tree, "metadata.data_type")
            read()
        end
    end
    each(ctx, cur, "StructureDataTypes", 18, described(function()
        read_node_id(cur, false)
        read_node_id(cur, false)
        cur:take(4, "StructureType")
        each(ctx, cur, "StructureDefinition Fields", 20, skip_structure_field)
    end))
    each(ctx, cur, "EnumDataTypes", 13, described(function()
        each(ctx, cur, "EnumDefinition Fields", 14, skip_enum_field)
        cur:take(1, "BuiltInType")
    end))
    each(ctx, cur, "SimpleDataTypes", 11, described(function()
        read_node_id(cur, false)
        cur:take(1, "BuiltInType")
    end))
end

local function read_description(ctx, cur, tree, name)
    localized_text(ctx, cur, tree, nil, name)
end

-- FieldMetaData (OPC 10000-14, 6.2.3.2.4)
local function read_field_metadata(ctx, cur, tree)
    within(ctx, tree, "metadata.field", cur, function(item)
        local name = text(ctx, cur, item, "metadata.field.name", "Name") or "(null)"
        read_description(ctx, cur, item, "metadata.field.description")
        u16(ctx, cur, item, "metadata.field.flags", "FieldFlags")
        local builtin = u8(ctx, cur, item, "metadata.field.builtin_type", "BuiltInType")
        node_id(ctx, cur, item, "metadata.field.data_type")
        local rank = i32(ctx, cur, item, "metadata.field.value_rank", "ValueRank")
        each(ctx, cur, "ArrayDimensions", 4, function()
            u32(ctx, cur, item, "metadata.field.array_dimension", "ArrayDimension")
        end)
        u32(ctx, cur, item, "metadata.field.max_string_length", "MaxStringLength")
        guid(ctx, cur, item, "metadata.field.id", "DataSetFieldId")
        each(ctx, cur, "Properties", 7, function()
            qualified_name(ctx, cur, item, "metadata.field.property")
            read_variant(ctx, cur, item, DEPTH)
        end)
        return string.format("%s, %s%s", name, BUILTIN[builtin] or "type " .. builtin, rank > 0 and "[]" or "")
    end)
end

-- DataSetMetaDataType (OPC 10000-14, 6.2.3.2.3)
local function read_metadata(ctx, cur, tree)
    return within(ctx, tree, "metadata", cur, function(item)
        read_schema(ctx, cur, item)
        local name = text(ctx, cur, item, "metadata.name", "Name") or ""
        read_description(ctx, cur, item, "metadata.description")
        local count = cur:count("Fields", 42) or 0
        for _ = 1, count do
            read_field_metadata(ctx, cur, item)
        end
        guid(ctx, cur, item, "metadata.data_set_class_id", "DataSetClassId")
        version(ctx, cur, item, "metadata.major_version", "MajorVersion")
        version(ctx, cur, item, "metadata.minor_version", "MinorVersion")
        return string.format('"%s"%s', name, count_of_fields(count))
    end)
end

-- What stands behind the header of an announcement, by its type; the rest is shown as bytes.
local BODY = {
    [2] = function(ctx, cur, tree)
        local writer_id = u16(ctx, cur, tree, "dataset_writer_id", "DataSetWriterId")
        local name = read_metadata(ctx, cur, tree)
        local status = status_code(ctx, cur, tree, "announcement.status", "StatusCode")
        return string.format(" of %d %s%s", writer_id, name, status == "Good" and "" or ", " .. status)
    end,
    [3] = function(ctx, cur, tree)
        return " of " .. read_writer_ids(ctx, cur, tree)
    end,
    [7] = function(ctx, cur, tree)
        local writer_id = u16(ctx, cur, tree, "dataset_writer_id", "DataSetWriterId")
        local targets = 0
        each(ctx, cur, "ActionTargets", 7, function()
            u16(ctx, cur, tree, "action.target_id", "ActionTargetId")
            text(ctx, cur, tree, "action.target_name", "Name")
            skip_localized_text(ctx, cur)
            targets = targets + 1
        end)
        local name = read_metadata(ctx, cur, tree)
        read_metadata(ctx, cur, tree)
        local at = cur.pos
        local methods = cur:count("ActionMethods", 4) or 0
        if methods ~= 0 and methods ~= targets then
            cur:problem(at, 4, string.format("%d ActionMethods for %d ActionTargets", methods, targets))
        end
        for _ = 1, 2 * methods do
            node_id(ctx, cur, tree, "action.method")
        end
        return string.format(" of %d %s", writer_id, name)
    end,
    [5] = function(ctx, cur, tree)
        local kind = u16(ctx, cur, tree, "announcement.application_information_type", "ApplicationInformationType")
        return ": " .. (APPLICATION_INFORMATION[kind] or "type " .. kind)
    end,
}

local function read_announcement(ctx, cur, tree)
    local kind = u8(ctx, cur, tree, "announcement.type", "AnnouncementType")
    local name = ANNOUNCEMENTS[kind]
    if not name then
        cur:problem(cur.pos - 1, 1, "AnnouncementType " .. kind .. " is reserved")
    end
    local number = u16(ctx, cur, tree, "announcement.sequence_number", "SequenceNumber")
    local words = string.format("seq %d: %s", number, name)
    -- Said even where the body cannot be read.
    ctx.info[#ctx.info + 1] = "announcement " .. words
    if BODY[kind] then
        words = words .. BODY[kind](ctx, cur, tree)
        ctx.info[#ctx.info] = "announcement " .. words
    end
    if kind == 2 then
        read_frame_padding(ctx, cur, tree, "the announcement")
    elseif cur:left() > 0 then
        put(ctx, tree, "announcement.body", cur:rest("Body"))
    end
    say(tree, " " .. words)
end

local function dissect_announcement(ctx, cur, tree)
    within(ctx, tree, "announcement", cur, function(item)
        guarded(ctx, item, cur, function()
            read_announcement(ctx, cur, item)
        end)
    end)
end

local function dissect_payload(ctx, cur, tree, head)
    if head.message_type == PROBE then
        dissect_probe(ctx, cur, tree)
    elseif head.message_type == ANNOUNCEMENT then
        dissect_announcement(ctx, cur, tree)
    else
        dissect_dataset_messages(ctx, cur, tree, head.writer_ids)
    end
end

-- Chunks (OPC 10000-14, 7.2.4.4.4). Frames are read in order once; what was put together then is remembered by the
-- frame that completed it, so that any frame can be shown again later.

local OPEN_AT_ONCE = 256
-- Seconds: sequence numbers come again, and the rest of a message that lost a chunk must not mix with a later one.
local OLDEST = 10
local chunks

local function forget_chunks()
    chunks = { open = {}, order = {}, whole = {}, completed_in = {}, problem = {} }
end

forget_chunks()

local function open_chunks(key, chunk)
    local entry = { total = chunk.total, bytes = 0, pieces = {}, frames = {}, marks = {}, since = chunk.time }
    if not chunks.open[key] then
        chunks.order[#chunks.order + 1] = key
    end
    chunks.open[key] = entry
    if #chunks.order > OPEN_AT_ONCE then
        chunks.open[table.remove(chunks.order, 1)] = nil
    end
    return entry
end

local function close_chunks(key)
    chunks.open[key] = nil
    for at, other in ipairs(chunks.order) do
        if other == key then
            table.remove(chunks.order, at)
            return
        end
    end
end

-- The pieces back to back, nil when they overlap or leave gaps.
local function joined(entry)
    local offsets, data, at = {}, {}, 0
    for offset in pairs(entry.pieces) do
        offsets[#offsets + 1] = offset
    end
    table.sort(offsets)
    for _, offset in ipairs(offsets) do
        if offset ~= at then
            return nil
        end
        data[#data + 1] = entry.pieces[offset]
        at = at + #entry.pieces[offset]
    end
    return at == entry.total and table.concat(data) or nil
end

-- Adds a chunk when its frame is read for the first time; a text says what is wrong with it.
local function collect(key, mark, frame, chunk)
    local entry = chunks.open[key]
    if not entry or chunk.time - entry.since > OLDEST then
        entry = open_chunks(key, chunk)
    end
    local problem
    local known = entry.pieces[chunk.offset]
    if known == chunk.data then
        return "a repeated chunk"
    elseif known then
        problem = "other data than the chunk of the same offset before it, which is dropped with its message"
        entry = open_chunks(key, chunk)
    end
    entry.pieces[chunk.offset] = chunk.data
    entry.bytes = entry.bytes + #chunk.data
    entry.frames[#entry.frames + 1] = frame
    entry.marks[#entry.marks + 1] = mark
    if entry.bytes >= entry.total then
        close_chunks(key)
        local data = joined(entry)
        if not data then
            return "the chunks overlap"
        end
        chunks.whole[mark] = { data = data, frames = entry.frames }
        for _, each_mark in ipairs(entry.marks) do
            chunks.completed_in[each_mark] = frame
        end
    end
    return problem
end

local function chunk_key(ctx, head, chunk)
    local pinfo = ctx.pinfo
    return table.concat({
        tostring(pinfo.src), tostring(pinfo.dst), pinfo.src_port, pinfo.dst_port, head.publisher or "",
        head.writer_group_id or "", head.writer_ids[1] or "", head.message_type, chunk.number, integer(chunk.total),
    }, "|")
end

local function dissect_whole(ctx, tree, head, whole)
    for _, frame in ipairs(whole.frames) do
        put(ctx, tree, "chunk.frame", nil, frame)
    end
    put(ctx, tree, "chunk.reassembled_length", nil, #whole.data)
    local tvb = ByteArray.new(whole.data, true):tvb("Reassembled UADP")
    local cur = cursor(tvb, 0, tvb:len())
    guarded(ctx, tree, cur, function()
        dissect_payload(ctx, cur, tree, head)
    end)
end

local function reassemble(ctx, cur, tree, head, chunk)
    local mark = string.format("%d:%d", ctx.pinfo.number, chunk.at)
    if not ctx.pinfo.visited then
        chunk.time = ctx.pinfo.abs_ts
        chunks.problem[mark] = collect(chunk_key(ctx, head, chunk), mark, ctx.pinfo.number, chunk)
    end
    if chunks.problem[mark] then
        note(ctx, tree, E.chunk, cur, chunk.at, 10, chunks.problem[mark])
    end
    local whole, completed_in = chunks.whole[mark], chunks.completed_in[mark]
    if whole then
        dissect_whole(ctx, tree, head, whole)
    elseif completed_in then
        put(ctx, tree, "chunk.reassembled_in", nil, completed_in)
    end
end

local function dissect_chunk(ctx, cur, tree, head)
    local chunk = { at = cur.pos }
    local item
    within(ctx, tree, "chunk", cur, function(inside)
        item = inside
        chunk.number = u16(ctx, cur, item, "chunk.message_sequence_number", "MessageSequenceNumber")
        chunk.offset = u32(ctx, cur, item, "chunk.offset", "ChunkOffset")
        chunk.total = u32(ctx, cur, item, "chunk.total_size", "TotalSize")
        local size = cur:left()
        local words = string.format("chunk %d: %d bytes from %s on, of %s", chunk.number, size, integer(chunk.offset),
            integer(chunk.total))
        ctx.info[#ctx.info + 1] = (head.writer_ids[1] and head.writer_ids[1] .. " " or "") .. words
        if size == 0 then
            cur:problem(cur.pos, 0, "a chunk without data")
        elseif chunk.offset + size > chunk.total then
            cur:problem(chunk.at + 2, 8, string.format("%d bytes from ChunkOffset %s on do not fit in TotalSize %s",
                size, integer(chunk.offset), integer(chunk.total)))
        end
        local range = cur:rest("ChunkData")
        put(ctx, item, "chunk.data", range)
        chunk.data = range:raw()
    end)
    if ctx.trial or not uadp.prefs.reassemble then
        return
    elseif chunk.total > uadp.prefs.max_total then
        note(ctx, item, E.chunk, cur, chunk.at + 6, 4, "larger than this dissector is set to reassemble")
        return
    end
    reassemble(ctx, cur, item or tree, head, chunk)
end

-- NetworkMessage headers (OPC 10000-14, 7.2.4.4.2)

local function read_flags(ctx, cur, tree, head)
    local flags = put_flags(ctx, tree, "flags", cur:take(1, "UADPFlags"))
    if flags % 16 ~= 1 then
        cur:problem(cur.pos - 1, 1, "UADPVersion " .. flags % 16 .. ", not 1")
    end
    local extended1 = bit(flags, 7) and put_flags(ctx, tree, "extended_flags1", cur:take(1, "ExtendedFlags1")) or 0
    if extended1 % 8 > 4 then
        cur:problem(cur.pos - 1, 1, "PublisherId type " .. extended1 % 8 .. " is reserved")
    end
    local extended2 = bit(extended1, 7) and put_flags(ctx, tree, "extended_flags2", cur:take(1, "ExtendedFlags2")) or 0
    head.flags, head.extended1, head.extended2 = flags, extended1, extended2
    head.message_type = bits(extended2, 2, 3)
    head.chunk = bit(extended2, 0)
    if extended2 >= 64 then
        cur:problem(cur.pos - 1, 1, string.format("ExtendedFlags2 0x%02x has reserved bits", extended2))
    elseif not MESSAGE_TYPES[head.message_type] then
        cur:problem(cur.pos - 1, 1, "NetworkMessage type " .. head.message_type .. " is reserved")
    elseif bit(extended2, 5) and head.message_type ~= DATA then
        cur:problem(cur.pos - 1, 1, "ActionHeader of a discovery message")
    end
    put(ctx, tree, "message_type", nil, head.message_type)
end

local PUBLISHER_ID_SIZE = { [0] = 1, 2, 4, 8 }

local function read_publisher_id(ctx, cur, tree, head)
    local kind = head.extended1 % 8
    local size = PUBLISHER_ID_SIZE[kind]
    if size then
        local range = cur:take(size, "PublisherId")
        local value = range:le_uint64()
        put(ctx, tree, "publisher_id", range, value)
        head.publisher = tostring(value)
        head.numeric = true
        return
    end
    local at = cur.pos
    head.publisher = text(ctx, cur, tree, "publisher_id.string", "PublisherId")
    -- Only who asks for applications has no name (OPC 10000-14, 7.2.4.6.12.3).
    if not head.publisher and head.message_type ~= PROBE then
        cur:problem(at, 4, "PublisherId is the null String")
    end
end

local function read_group_header(ctx, cur, tree, head)
    within(ctx, tree, "group_header", cur, function(item)
        local flags = put_flags(ctx, item, "group_flags", cur:take(1, "GroupFlags"))
        if flags > 15 then
            cur:problem(cur.pos - 1, 1, string.format("GroupFlags 0x%02x has reserved bits", flags))
        end
        if bit(flags, 0) then
            head.writer_group_id = u16(ctx, cur, item, "writer_group_id", "WriterGroupId")
        end
        if bit(flags, 1) then
            version(ctx, cur, item, "group_version", "GroupVersion")
        end
        if bit(flags, 2) then
            u16(ctx, cur, item, "network_message_number", "NetworkMessageNumber")
        end
        if bit(flags, 3) then
            u16(ctx, cur, item, "sequence_number", "SequenceNumber")
        end
        return head.writer_group_id and "WriterGroupId " .. head.writer_group_id
    end)
end

local function read_writer_id(ctx, cur, tree, head)
    local id = u16(ctx, cur, tree, "dataset_writer_id", "DataSetWriterId")
    head.writer_ids[#head.writer_ids + 1] = id
    if head.numeric and head.writer_group_id then
        local topic = string.format("ua_%s_%d_%d", head.publisher, head.writer_group_id, id)
        put(ctx, tree, "topic", nil, topic)
    end
end

local function read_payload_header(ctx, cur, tree, head)
    within(ctx, tree, "payload_header", cur, function(item)
        local count = 1
        if not head.chunk then
            count = u8(ctx, cur, item, "count", "Count")
            if count == 0 then
                cur:problem(cur.pos - 1, 1, "Count is 0")
            end
        end
        for _ = 1, count do
            read_writer_id(ctx, cur, item, head)
        end
        return table.concat(head.writer_ids, ", ")
    end)
end

local function read_promoted_fields(ctx, cur, tree)
    within(ctx, tree, "promoted_fields", cur, function(item)
        local size = u16(ctx, cur, item, "promoted_fields.size", "PromotedFields Size")
        local fields = cur:sub(size, "PromotedFields")
        local number = 0
        guarded(ctx, item, fields, function()
            while fields:left() > 0 do
                within(ctx, item, "field", fields, function(inside)
                    put(ctx, inside, "field.index", nil, number)
                    say(inside, " " .. number)
                    return read_variant(ctx, fields, inside, DEPTH)
                end)
                number = number + 1
            end
        end)
    end)
end

local function read_nonce(ctx, cur, tree, head)
    local length = u8(ctx, cur, tree, "security.nonce_length", "NonceLength")
    if length == 0 then
        return
    end
    local at = cur.pos
    local nonce = put(ctx, tree, "security.nonce", cur:take(length, "MessageNonce"))
    -- The AES-CTR policies: 4 random bytes and a sequence number (OPC 10000-14, 7.2.4.4.3.2).
    if length == 8 then
        put(ctx, nonce, "security.nonce.random", cur.tvb:range(at, 4))
        local sequence = cur.tvb:range(at + 4, 4)
        put(ctx, nonce, "security.nonce.sequence_number", sequence)
        head.nonce = integer(sequence:le_uint())
    end
end

local function read_security_header(ctx, cur, tree, head)
    within(ctx, tree, "security", cur, function(item)
        local flags = put_flags(ctx, item, "security.flags", cur:take(1, "SecurityFlags"))
        head.signed, head.encrypted = bit(flags, 0), bit(flags, 1)
        if flags > 15 then
            cur:problem(cur.pos - 1, 1, string.format("SecurityFlags 0x%02x has reserved bits", flags))
        end
        head.token = integer((u32(ctx, cur, item, "security.token_id", "SecurityTokenId")))
        read_nonce(ctx, cur, item, head)
        if bit(flags, 2) then
            head.footer_size = u16(ctx, cur, item, "security.footer_size", "SecurityFooterSize")
        end
        local mode = head.encrypted and (head.signed and "signed and encrypted" or "encrypted")
            or head.signed and "signed" or "none"
        return mode
    end)
end

local function read_headers(ctx, cur, tree, head)
    read_flags(ctx, cur, tree, head)
    if bit(head.flags, 4) then
        read_publisher_id(ctx, cur, tree, head)
    end
    if bit(head.extended1, 3) then
        guid(ctx, cur, tree, "data_set_class_id", "DataSetClassId")
    end
    if bit(head.flags, 5) then
        read_group_header(ctx, cur, tree, head)
    end
    if bit(head.flags, 6) then
        read_payload_header(ctx, cur, tree, head)
    end
    if bit(head.extended1, 5) then
        datetime(ctx, cur, tree, "timestamp", "Timestamp")
    end
    if bit(head.extended1, 6) then
        u16(ctx, cur, tree, "picoseconds", "PicoSeconds")
    end
    if bit(head.extended2, 1) then
        read_promoted_fields(ctx, cur, tree)
    end
    if bit(head.extended1, 4) then
        read_security_header(ctx, cur, tree, head)
    elseif head.message_type ~= DATA then
        -- Required even where nothing is secured (OPC 10000-14, 7.2.4.6.3 and 7.2.4.6.12.1).
        note(ctx, tree, E.malformed, cur, 1, 1, "a discovery message without SecurityHeader")
    end
end

-- Length of an HMAC-SHA256, which both AES-CTR policies sign with (OPC 10000-7, PubSub-Aes128-CTR, -Aes256-CTR).
local SIGNATURE = 32

-- Splits footer and signature off the end; what is between headers and them is the payload.
local function split_end(cur, head)
    local at = cur.stop
    local function before(length, what)
        if at - length < cur.pos then
            cur:problem(cur.pos, cur.stop - cur.pos, string.format("%s of %d bytes does not fit in the %d left", what,
                length, at - cur.pos))
        end
        at = at - length
        return { at = at, length = length }
    end
    local signature = head.signed and before(SIGNATURE, "Signature") or nil
    local footer = head.footer_size and before(head.footer_size, "SecurityFooter") or nil
    return cur:sub(at - cur.pos, "payload"), footer, signature
end

local function dissect_encrypted(ctx, cur, tree, head)
    put(ctx, tree, "encrypted_payload", cur:rest("Encrypted payload"))
    local ids = table.concat(head.writer_ids, ", ")
    local nonce = head.nonce and ", nonce seq " .. head.nonce or ""
    ctx.info[#ctx.info + 1] = string.format("%s%sencrypted (token %s%s)", ids, ids == "" and "" or " ", head.token,
        nonce)
end

-- Bytes of a RequestorId by its builtin type.
local REQUESTOR_ID_SIZE = { [3] = 1, [5] = 2, [7] = 4, [9] = 8 }

local function read_requestor_id(ctx, cur, tree)
    local at = cur.pos
    local builtin = math.floor(cur:take(1, "RequestorId"):uint())
    local size = REQUESTOR_ID_SIZE[builtin]
    if size then
        local range = cur:take(size, "RequestorId")
        local value = range:le_uint64()
        put(ctx, tree, "action.requestor_id", range, value)
        return tostring(value)
    elseif builtin ~= 12 then
        cur:problem(at, 1, string.format("Variant encoding 0x%02x is none of a RequestorId", builtin))
    end
    local id = text(ctx, cur, tree, "action.requestor_id.string", "RequestorId")
    if not id then
        cur:problem(at, 5, "RequestorId is the null String")
    end
    return '"' .. shortened(id) .. '"'
end

-- ActionHeader, which stands in front of the payload and is encrypted with it (OPC 10000-14, 7.2.4.4.2). The numbering
-- of the flags is that of UA-.NETStandard.
local function read_action_header(ctx, cur, tree)
    within(ctx, tree, "action", cur, function(item)
        local flags = put_flags(ctx, item, "action.flags", cur:take(1, "ActionFlags"))
        if flags > 31 then
            cur:problem(cur.pos - 1, 1, string.format("ActionFlags 0x%02x has reserved bits", flags))
        end
        ctx.action = bit(flags, 0) and ACTION_REQUEST or ACTION_RESPONSE
        local words = bit(flags, 0) and "request" or "response"
        if bit(flags, 1) and not text(ctx, cur, item, "action.response_address", "ResponseAddress") then
            cur:problem(cur.pos - 4, 4, "ResponseAddress is null")
        end
        if bit(flags, 2) then
            local data = cur:byte_string("CorrelationData")
            if not data then
                cur:problem(cur.pos - 4, 4, "CorrelationData are null")
            end
            put(ctx, item, "action.correlation_data", data)
        end
        if bit(flags, 3) then
            words = words .. " of " .. read_requestor_id(ctx, cur, item)
        end
        if bit(flags, 4) then
            put(ctx, item, "action.timeout_hint", cur:take(8, "TimeoutHint"))
        end
        return words
    end)
end

local function dissect_action(ctx, cur, tree, head)
    if head.chunk then
        local at, left = cur.pos, cur:left()
        note(ctx, tree, E.undecoded, cur, at, left, "chunks with an ActionHeader are not dissected")
        put(ctx, tree, "undissected", cur:rest("Chunk"))
        ctx.info[#ctx.info + 1] = "chunk of an Action"
        return
    end
    read_action_header(ctx, cur, tree)
    if not bit(head.flags, 4) or not bit(head.flags, 6) then
        cur:problem(0, 1, "an Action without PublisherId or payload header, which it is addressed by")
    end
    dissect_dataset_messages(ctx, cur, tree, head.writer_ids)
end

local function dissect_body(ctx, cur, tree, head)
    if head.encrypted then
        dissect_encrypted(ctx, cur, tree, head)
    elseif bit(head.extended2, 5) then
        dissect_action(ctx, cur, tree, head)
    elseif head.chunk then
        dissect_chunk(ctx, cur, tree, head)
    else
        dissect_payload(ctx, cur, tree, head)
    end
end

local function put_end(ctx, cur, tree, name, part)
    if part then
        put(ctx, tree, name, cursor(cur.tvb, part.at, cur.stop):take(part.length, name))
    end
end

local function dissect_network_message(ctx, cur, tree)
    local head = { writer_ids = {} }
    ctx.head = head
    local fine = guarded(ctx, tree, cur, function()
        read_headers(ctx, cur, tree, head)
    end)
    if not fine then
        return
    end
    local payload, footer, signature
    fine = guarded(ctx, tree, cur, function()
        payload, footer, signature = split_end(cur, head)
    end)
    if not fine then
        return
    end
    guarded(ctx, tree, payload, function()
        dissect_body(ctx, payload, tree, head)
    end)
    guarded(ctx, tree, cur, function()
        put_end(ctx, cur, tree, "security.footer", footer)
        put_end(ctx, cur, tree, "security.signature", signature)
        cur.pos = cur.stop
    end)
end

-- Entry points

local function new_context(pinfo, trial)
    return { pinfo = pinfo, trial = trial, items = uadp.prefs.max_items, hidden = 0, info = {}, head = {} }
end

-- "PublisherId 2 WriterGroup 5: 10 key frame seq 3 (2 fields)"
local function info_text(ctx)
    local who = {}
    if ctx.head.publisher then
        who[1] = "PublisherId " .. (ctx.head.numeric and ctx.head.publisher or '"' .. ctx.head.publisher .. '"')
    end
    if ctx.head.writer_group_id then
        who[#who + 1] = "WriterGroup " .. ctx.head.writer_group_id
    end
    if ctx.malformed then
        ctx.info[#ctx.info + 1] = "[malformed: " .. ctx.malformed.text .. "]"
    end
    local what = table.concat(ctx.info, ", ")
    local whole = table.concat(who, " ")
    return whole .. (whole ~= "" and what ~= "" and ": " or "") .. what
end

function uadp.dissector(tvb, pinfo, root)
    if tvb:reported_len() == 0 then
        return 0
    end
    pinfo.cols.protocol = "UADP"
    local tree = root:add(uadp, tvb())
    local ctx = new_context(pinfo, false)
    ctx.root, ctx.datagram = tree, tvb
    local fine, problem = pcall(function()
        dissect_network_message(ctx, cursor(tvb, 0, tvb:reported_len()), tree)
        if ctx.hidden > 0 then
            tree:add_proto_expert_info(E.hidden, ctx.hidden .. " more items are not shown")
        end
    end)
    if not fine then
        tree:add_proto_expert_info(E.bug, "the dissector failed: " .. tostring(problem))
    end
    local info = info_text(ctx)
    pinfo.cols.info = info
    tree:append_text(", " .. info)
    return tvb:len()
end

-- Other ports: only what has all three names, is read to its last byte without a flaw, and brings at least a field.
local function looks_like_uadp(tvb, pinfo)
    local length = tvb:reported_len()
    if length < 12 or tvb:len() < length or tvb:range(0, 1):uint() ~= 0xF1 then
        return false
    end
    local ctx = new_context(pinfo, true)
    local fine = pcall(function()
        dissect_network_message(ctx, cursor(tvb, 0, length), nil)
    end)
    local head = ctx.head
    local named = (head.writer_group_id or 0) ~= 0 and (head.writer_ids[1] or 0) ~= 0
    local sent = ctx.info[1] and ctx.info[1]:find("field", 1, true) and not ctx.info[1]:find("(0 fields)", 1, true)
    return fine and not ctx.malformed and named and sent and true or false
end

local function heuristic(tvb, pinfo, root)
    if not uadp.prefs.heuristic or not looks_like_uadp(tvb, pinfo) then
        return false
    end
    uadp.dissector(tvb, pinfo, root)
    return true
end

function uadp.init()
    forget_chunks()
end

local udp = DissectorTable.get("udp.port")
local ports = uadp.prefs.ports

function uadp.prefs_changed()
    if ports ~= uadp.prefs.ports then
        udp:remove(ports, uadp)
        ports = uadp.prefs.ports
        udp:add(ports, uadp)
    end
end

udp:add(ports, uadp)
-- UADP over Ethernet (OPC 10000-14, 7.3.3).
DissectorTable.get("ethertype"):add(0xB62C, uadp)
uadp:register_heuristic("udp", heuristic)
