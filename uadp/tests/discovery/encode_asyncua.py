"""Writes asyncua.hex: structures of OPC UA in the binary encoding, one `NAME HEX` a line.

    python3 -m venv /tmp/venv && /tmp/venv/bin/pip install asyncua==2.1.0
    /tmp/venv/bin/python uadp/tests/discovery/encode_asyncua.py > uadp/tests/discovery/asyncua.hex

What is in them is repeated in asyncua.rs beside this file.
"""

from uuid import UUID

from asyncua import ua
from asyncua.ua.ua_binary import struct_to_binary


def text(value, locale=None):
    return ua.LocalizedText(value, locale)


def node(identifier, namespace=0):
    return ua.NodeId(identifier, namespace)


def meta_data():
    pose = ua.StructureDescription(
        DataTypeId=node(3001, 1),
        Name=ua.QualifiedName("Pose", 1),
        StructureDefinition=ua.StructureDefinition(
            DefaultEncodingId=node(5001, 1),
            BaseDataType=node(22),
            StructureType=ua.StructureType.StructureWithOptionalFields,
            Fields=[
                ua.StructureField(
                    Name="position",
                    Description=text("in metres", "en"),
                    DataType=node(11),
                    ValueRank=1,
                    ArrayDimensions=[3],
                    MaxStringLength=0,
                    IsOptional=False,
                ),
                ua.StructureField(
                    Name="frame",
                    Description=text(None),
                    DataType=node("Frame", 1),
                    ValueRank=-1,
                    ArrayDimensions=[],
                    MaxStringLength=16,
                    IsOptional=True,
                ),
            ],
        ),
    )
    mode = ua.EnumDescription(
        DataTypeId=node("Mode", 1),
        Name=ua.QualifiedName("Mode", 1),
        EnumDefinition=ua.EnumDefinition(
            Fields=[
                ua.EnumField(Value=0, DisplayName=text("idle"), Description=text(None), Name="Idle"),
                ua.EnumField(Value=-7, DisplayName=text("works"), Description=text(None), Name="Works"),
            ]
        ),
        BuiltInType=6,
    )
    frame = ua.SimpleTypeDescription(
        DataTypeId=node("Frame", 1),
        Name=ua.QualifiedName("Frame", 1),
        BaseDataType=node(12),
        BuiltInType=12,
    )
    field = ua.FieldMetaData(
        Name="pose",
        Description=text("where it is", "en"),
        FieldFlags=ua.DataSetFieldFlags.PromotedField,
        BuiltInType=22,
        DataType=node(3001, 1),
        ValueRank=-1,
        ArrayDimensions=[],
        MaxStringLength=0,
        DataSetFieldId=UUID("72962B91-FA75-4AE6-8D28-B404DC7DAF63"),
        Properties=[ua.KeyValuePair(ua.QualifiedName("unit", 0), ua.Variant(42, ua.VariantType.Int32))],
    )
    return ua.DataSetMetaDataType(
        Namespaces=["urn:cell:robot"],
        StructureDataTypes=[pose],
        EnumDataTypes=[mode],
        SimpleDataTypes=[frame],
        Name="robot_status",
        Description=text("the robot", "en"),
        Fields=[field],
        DataSetClassId=UUID("00000000-0000-0000-0000-000000000001"),
        ConfigurationVersion=ua.ConfigurationVersionDataType(MajorVersion=700000000, MinorVersion=700000060),
    )


def endpoint():
    return ua.EndpointDescription(
        EndpointUrl="opc.tcp://cell1:4840/",
        Server=ua.ApplicationDescription(
            ApplicationUri="urn:cell:server",
            ProductUri="urn:product",
            ApplicationName=text("server", "en"),
            ApplicationType=ua.ApplicationType.ClientAndServer,
            GatewayServerUri=None,
            DiscoveryProfileUri=None,
            DiscoveryUrls=["opc.tcp://cell1:4840/", None],
        ),
        ServerCertificate=b"\x30\x82\x01",
        SecurityMode=ua.MessageSecurityMode.SignAndEncrypt,
        SecurityPolicyUri="http://opcfoundation.org/UA/SecurityPolicy#Basic256Sha256",
        UserIdentityTokens=[
            ua.UserTokenPolicy(
                PolicyId="anonymous",
                TokenType=ua.UserTokenType.Anonymous,
                IssuedTokenType=None,
                IssuerEndpointUrl=None,
                SecurityPolicyUri=None,
            )
        ],
        TransportProfileUri="http://opcfoundation.org/UA-Profile/Transport/uatcp-uasc-uabinary",
        SecurityLevel=3,
    )


def writer_group():
    writer = ua.DataSetWriterDataType(
        Name="writer",
        Enabled=True,
        DataSetWriterId=10,
        DataSetFieldContentMask=ua.DataSetFieldContentMask.RawData,
        KeyFrameCount=5,
        DataSetName="robot_status",
        DataSetWriterProperties=[],
        TransportSettings=None,
        MessageSettings=ua.UadpDataSetWriterMessageDataType(
            DataSetMessageContentMask=ua.UadpDataSetMessageContentMask(0x25),
            ConfiguredSize=64,
            NetworkMessageNumber=1,
            DataSetOffset=15,
        ),
    )
    return ua.WriterGroupDataType(
        Name="group",
        Enabled=True,
        SecurityMode=ua.MessageSecurityMode.Sign,
        SecurityGroupId="keys",
        SecurityKeyServices=[endpoint()],
        MaxNetworkMessageSize=1472,
        GroupProperties=[ua.KeyValuePair(ua.QualifiedName("note", 2), ua.Variant("text", ua.VariantType.String))],
        WriterGroupId=5,
        PublishingInterval=100.0,
        KeepAliveTime=1000.0,
        Priority=7,
        LocaleIds=["en", "de"],
        HeaderLayoutUri="http://opcfoundation.org/UA/PubSub-Layouts/UADP-Dynamic",
        TransportSettings=ua.DatagramWriterGroupTransport2DataType(
            MessageRepeatCount=2,
            MessageRepeatDelay=1.5,
            Address=ua.NetworkAddressUrlDataType(NetworkInterface=None, Url="opc.udp://239.0.0.1:4840"),
            QosCategory="opc.qos.cat://priority",
            DatagramQos=[ua.TransmitQosPriorityDataType(PriorityLabel="high")],
            DiscoveryAnnounceRate=60,
            Topic="topic",
        ),
        MessageSettings=ua.UadpWriterGroupMessageDataType(
            GroupVersion=700000000,
            DataSetOrdering=ua.DataSetOrderingType.AscendingWriterId,
            NetworkMessageContentMask=ua.UadpNetworkMessageContentMask(0x47),
            SamplingOffset=-1.0,
            PublishingOffset=[0.5, 1.5],
        ),
        DataSetWriters=[writer],
    )


def connection():
    reader = ua.DataSetReaderDataType(
        Name="reader",
        Enabled=False,
        PublisherId=ua.Variant(2, ua.VariantType.UInt16),
        WriterGroupId=5,
        DataSetWriterId=10,
        DataSetMetaData=meta_data(),
        DataSetFieldContentMask=ua.DataSetFieldContentMask.StatusCode,
        MessageReceiveTimeout=250.0,
        KeyFrameCount=1,
        HeaderLayoutUri=None,
        SecurityMode=ua.MessageSecurityMode.Invalid,
        SecurityGroupId=None,
        SecurityKeyServices=[],
        DataSetReaderProperties=[],
        TransportSettings=None,
        MessageSettings=None,
        SubscribedDataSet=None,
    )
    readers = ua.ReaderGroupDataType(
        Name="readers",
        Enabled=True,
        SecurityMode=ua.MessageSecurityMode.None_,
        SecurityGroupId=None,
        SecurityKeyServices=[],
        MaxNetworkMessageSize=0,
        GroupProperties=[],
        TransportSettings=None,
        MessageSettings=None,
        DataSetReaders=[reader],
    )
    return ua.PubSubConnectionDataType(
        Name="connection",
        Enabled=True,
        PublisherId=ua.Variant(2, ua.VariantType.UInt16),
        TransportProfileUri="http://opcfoundation.org/UA-Profile/Transport/pubsub-udp-uadp",
        Address=ua.NetworkAddressUrlDataType(NetworkInterface="eth0", Url="opc.udp://239.0.0.1:4840"),
        ConnectionProperties=[],
        TransportSettings=ua.DatagramConnectionTransport2DataType(
            DiscoveryAddress=ua.NetworkAddressUrlDataType(NetworkInterface=None, Url="opc.udp://224.0.2.14:4840"),
            DiscoveryAnnounceRate=30,
            DiscoveryMaxMessageSize=4096,
            QosCategory=None,
            DatagramQos=[],
        ),
        WriterGroups=[writer_group()],
        ReaderGroups=[readers],
    )


def old_connection():
    return ua.PubSubConnectionDataType(
        Name="old",
        Enabled=False,
        PublisherId=ua.Variant("cell", ua.VariantType.String),
        TransportProfileUri=None,
        Address=None,
        ConnectionProperties=[],
        TransportSettings=ua.DatagramConnectionTransportDataType(
            DiscoveryAddress=ua.NetworkAddressUrlDataType(NetworkInterface=None, Url="opc.udp://224.0.2.14:4840")
        ),
        WriterGroups=[
            ua.WriterGroupDataType(
                Name="old group",
                LocaleIds=[],
                TransportSettings=ua.DatagramWriterGroupTransportDataType(
                    MessageRepeatCount=3, MessageRepeatDelay=2.5
                ),
                MessageSettings=None,
                DataSetWriters=[],
            )
        ],
        ReaderGroups=[],
    )


for make in (meta_data, endpoint, writer_group, connection, old_connection):
    print(make.__name__, struct_to_binary(make()).hex())
for number, (name, value) in enumerate(
    (
        ("action_target", ua.ActionTargetDataType(ActionTargetId=9, Name="target", Description=text("it", "en"))),
        ("action_method", ua.ActionMethodDataType(ObjectId=node("Robot", 2), MethodId=node(7001, 2))),
    )
):
    print(name, struct_to_binary(value).hex())
