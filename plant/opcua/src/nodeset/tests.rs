use opcua::nodes::NodeType;
use opcua::server::address_space::AddressSpace;
use opcua::types::{
    ByteString, DateTime, NamespaceMap, NodeId, ObjectId, ReferenceTypeId, Variant,
};

use super::{Imported, ImportedNodeSets, NodeSetError};

/// Returns a NodeSet with a single namespace, with the elements from line 3 on.
fn document(elements: &str) -> String {
    format!(
        "<UANodeSet xmlns=\"http://opcfoundation.org/UA/2011/03/UANodeSet.xsd\" xmlns:t=\"http://opcfoundation.org/UA/2008/02/Types.xsd\">\
         <NamespaceUris><Uri>urn:a</Uri></NamespaceUris>\n\n{elements}\n</UANodeSet>"
    )
}

fn variable(id: u32, data_type: &str, value: &str) -> String {
    format!(
        "<UAVariable NodeId=\"ns=1;i={id}\" BrowseName=\"1:V{id}\" DataType=\"{data_type}\">\n<Value>\n{value}</Value></UAVariable>\n"
    )
}

/// Imports a document, and returns the address space and the findings.
fn imported(bytes: &[u8]) -> (AddressSpace, Imported, Vec<NodeSetError>) {
    let (sets, faults) = ImportedNodeSets::of_document("a.xml", bytes);
    let mut space = AddressSpace::new();
    let there = sets.import(&mut space, &mut NamespaceMap::new()).unwrap();
    let faults = faults.into_iter().map(|fault| fault.error).collect();
    (space, there, faults)
}

fn value_of(space: &AddressSpace, id: u32) -> Option<Variant> {
    match space.find(&NodeId::new(1, id)) {
        Some(NodeType::Variable(variable)) => crate::server::value_of(variable).value,
        _ => None,
    }
}

/// Returns the imported value of a variable with this value in its file.
fn read(value: &str) -> Result<Variant, String> {
    let (space, _, faults) = imported(document(&variable(7, "i=24", value)).as_bytes());
    match faults.first() {
        Some(fault) => Err(fault.to_string()),
        None => value_of(&space, 7).ok_or_else(|| "no value".to_owned()),
    }
}

fn fault(elements: &str) -> String {
    let (_, faults) = ImportedNodeSets::of_document("a.xml", document(elements).as_bytes());
    let first = faults.into_iter().next().unwrap();
    first.error.to_string()
}

#[test]
fn legal_forms_of_values_are_read() {
    let int = Variant::Int32(4);
    let boxed = |value: Variant| Variant::Variant(Box::new(value));
    let bytes = Variant::from(ByteString::from(b"ABCDEF"));
    for (text, expected) in [
        ("<t:Double>\n 1.5 </t:Double>", Variant::Double(1.5)),
        ("<t:Boolean>1</t:Boolean>", Variant::Boolean(true)),
        ("<t:Boolean>false</t:Boolean>", Variant::Boolean(false)),
        (
            "<t:DateTime>2026-03-01T10:00:00</t:DateTime>",
            DateTime::ymd_hms(2026, 3, 1, 10, 0, 0).into(),
        ),
        ("<t:ByteString>QUJD\n  REVG\n</t:ByteString>", bytes),
        (
            "<t:Variant><t:Value><t:Int32>4</t:Int32></t:Value></t:Variant>",
            boxed(int.clone()),
        ),
        ("<t:Variant/>", boxed(Variant::Empty)),
    ] {
        assert_eq!(read(text), Ok(expected), "{text}");
    }
    // Times before the first DateTime of OPC UA become the first DateTime.
    let Ok(Variant::DateTime(time)) = read("<t:DateTime>0001-01-01T00:00:00</t:DateTime>") else {
        panic!("no time");
    };
    assert_eq!(time.checked_ticks(), 0);
    let list = "<t:ListOfVariant><t:Variant><t:Value><t:Int32>4</t:Int32></t:Value></t:Variant></t:ListOfVariant>";
    let Ok(Variant::Array(list)) = read(list) else {
        panic!("no list");
    };
    assert_eq!(list.values, [boxed(int)]);
    let matrix = "<t:Matrix><t:Dimensions><t:UInt32>2</t:UInt32><t:UInt32>1</t:UInt32></t:Dimensions>\
        <t:Elements><t:Int32>1</t:Int32><t:Int32>2</t:Int32></t:Elements></t:Matrix>";
    let Ok(Variant::Array(matrix)) = read(matrix) else {
        panic!("no matrix");
    };
    assert_eq!(matrix.dimensions, Some(vec![2, 1]));
    assert_eq!(matrix.values, [Variant::Int32(1), Variant::Int32(2)]);
}

#[test]
fn wrong_values_are_found_with_their_line_and_node() {
    for (value, what) in [
        ("<t:Double>1,5</t:Double>", "as float"),
        ("<t:Boolean>True</t:Boolean>", "as bool"),
        ("<t:Byte>0x10</t:Byte>", "as integer"),
        ("<t:Int64>9223372036854775808</t:Int64>", "as integer"),
        ("<t:Wrong/>", "Unknown variant type"),
    ] {
        let wrong = variable(2, "i=24", value);
        let told = fault(&format!(
            "{}{wrong}",
            variable(1, "i=1", "<t:Boolean>1</t:Boolean>")
        ));
        // The first variable is at the lines 3 to 5.
        assert!(told.starts_with("a.xml:8: node ns=1;i=2: "), "{told}");
        assert!(told.contains(what), "{told}");
    }
    let told = fault("<UAObject NodeId=\"ns=1;i=1\" BrowseName=\"9:A\"/>");
    assert!(told.starts_with("a.xml:3: node ns=1;i=1: "), "{told}");
    let told = fault("<UAObject BrowseName=\"1:A\"/>");
    assert!(
        told.starts_with("a.xml is not a NodeSet2 document: line 3: "),
        "{told}"
    );
}

#[test]
fn values_that_cannot_be_sent_are_left_out_with_their_line_node_and_reason() {
    let wrong = variable(2, "i=15", "<t:ByteString>QUJ</t:ByteString>");
    let many: String = (3..=16)
        .map(|id| variable(id, "i=15", "<t:ByteString>!</t:ByteString>"))
        .collect();
    let (space, there, faults) = imported(document(&format!("{wrong}{many}")).as_bytes());
    let told: Vec<String> = faults.iter().map(ToString::to_string).collect();
    let first = "a.xml:3: node ns=1;i=2: the value cannot be read: ";
    assert!(
        told[0].starts_with(first) && told[0].contains("base64"),
        "{told:?}"
    );
    assert!(told[1].starts_with("a.xml:6: node ns=1;i=3: "), "{told:?}");
    assert_eq!(told.len(), 11);
    assert_eq!(told[10], "a.xml: cannot read the values of 5 more nodes");
    assert!(faults.iter().all(|fault| !fault.is_fatal()));
    assert_eq!((there.nodes.len(), there.unread.len()), (15, 15));
    assert_eq!(value_of(&space, 2), None);
}

#[test]
fn deep_values_are_findings() {
    let deep = |times: usize| {
        let (open, close) = ("<t:Variant><t:Value>", "</t:Value></t:Variant>");
        format!(
            "{}<t:Int32>1</t:Int32>{}",
            open.repeat(times),
            close.repeat(times)
        )
    };
    assert!(read(&deep(10)).is_ok());
    assert!(read(&deep(25)).is_ok());
    for times in [50, 3_000, 100_000] {
        let told = read(&deep(times)).unwrap_err();
        assert!(
            told.contains("node ns=1;i=7: Elements are nested deeper"),
            "{told}"
        );
    }
    // A structure with a field of its own type.
    let structure = "<UADataType NodeId=\"ns=1;i=1\" BrowseName=\"1:A\"><References><Reference ReferenceType=\"i=45\" IsForward=\"false\">i=22</Reference>\
        <Reference ReferenceType=\"i=38\">ns=1;i=3</Reference></References><Definition Name=\"1:A\"><Field Name=\"a\" DataType=\"ns=1;i=1\"/></Definition></UADataType>\
        <UAObject NodeId=\"ns=1;i=3\" BrowseName=\"Default Binary\"><References><Reference ReferenceType=\"i=38\" IsForward=\"false\">ns=1;i=1</Reference></References></UAObject>";
    for times in [40, 3_000] {
        let body = format!(
            "<A xmlns=\"urn:a\">{}{}</A>",
            "<a>".repeat(times),
            "</a>".repeat(times)
        );
        let value = format!(
            "<t:ExtensionObject><t:TypeId><t:Identifier>ns=1;i=3</t:Identifier></t:TypeId><t:Body>{body}</t:Body></t:ExtensionObject>"
        );
        let told = fault(&format!("{structure}{}", variable(7, "ns=1;i=1", &value)));
        assert!(told.contains("node ns=1;i=7: "), "{told}");
    }
}

#[test]
fn data_types_that_are_their_own_supertypes_are_refused() {
    let data_type = |id: u32, above: u32| {
        format!(
            "<UADataType NodeId=\"ns=1;i={id}\" BrowseName=\"1:T{id}\"><References>\
             <Reference ReferenceType=\"i=45\" IsForward=\"false\">ns=1;i={above}</Reference></References>\
             <Definition Name=\"1:T{id}\"><Field Name=\"a\" DataType=\"i=1\"/></Definition></UADataType>\n"
        )
    };
    let told = fault(&format!("{}{}", data_type(1, 2), data_type(2, 1)));
    assert!(
        told.starts_with("a.xml:3: node ns=1;i=1: it has more than 64 supertypes"),
        "{told}"
    );
}

#[test]
fn documents_are_read_in_the_encoding_that_they_name() {
    let text = |encoding: &str| {
        let body = document(&variable(7, "i=12", "<t:String>°C</t:String>"));
        format!("<?xml version=\"1.0\" encoding=\"{encoding}\"?>\n{body}")
    };
    let utf16 = format!("\u{feff}{}", text("utf-16"));
    let latin = text("iso-8859-1");
    for bytes in [
        text("utf-8").into_bytes(),
        utf16.encode_utf16().flat_map(u16::to_le_bytes).collect(),
        latin
            .chars()
            .map(|c| u8::try_from(u32::from(c)).unwrap())
            .collect(),
    ] {
        let (space, _, faults) = imported(&bytes);
        assert!(faults.is_empty(), "{faults:?}");
        assert_eq!(value_of(&space, 7), Some(Variant::from("°C")));
    }
}

#[test]
fn nodes_of_the_core_namespace_are_left_out_and_their_references_kept() {
    let core = "<UAObject NodeId=\"i=85\" BrowseName=\"Objects\"><References>\
        <Reference ReferenceType=\"i=35\">ns=1;i=1</Reference><Reference ReferenceType=\"i=40\">i=61</Reference></References></UAObject>";
    let own = "<UAObject NodeId=\"ns=1;i=1\" BrowseName=\"1:Line\"/>";
    let (space, there, faults) = imported(document(&format!("{core}{own}")).as_bytes());
    assert!(faults.is_empty(), "{faults:?}");
    let line = NodeId::new(1, 1);
    assert_eq!(there.nodes, std::slice::from_ref(&line));
    let objects: NodeId = ObjectId::ObjectsFolder.into();
    assert!(space.has_reference(&objects, &line, ReferenceTypeId::Organizes));
    assert_eq!(
        fault(core),
        "a.xml has nodes of the core namespace, as i=85"
    );
}

#[test]
fn the_core_namespace_may_be_listed_as_index_0_and_as_index_1() {
    for (index, listed) in [(1, "urn:a"), (2, "urn:a"), (2, "urn:x</Uri><Uri>urn:a")] {
        let text = format!(
            "<UANodeSet><NamespaceUris><Uri>http://opcfoundation.org/UA/</Uri><Uri>{listed}</Uri></NamespaceUris>\
             <UAObject NodeId=\"ns={index};i=1\" BrowseName=\"{index}:A\"/></UANodeSet>"
        );
        let (sets, faults) = ImportedNodeSets::of_document("a.xml", text.as_bytes());
        assert!(faults.is_empty(), "{faults:?}");
        assert_eq!(sets.provides().collect::<Vec<_>>(), ["urn:a"], "{text}");
    }
}
