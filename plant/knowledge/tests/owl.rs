//! NodeSets as ontologies, compared with the counts of the XML.

use std::collections::BTreeSet;

use knowledge::owl::Ontology;
use knowledge::{Knowledge, KnowledgeSource, SourceKind};
use test_data::{foreign, read_foreign};

const UA: &str = "http://opcfoundation.org/UA/";

/// The statements of an ontology as N-Triples.
fn lines(ontology: &Ontology) -> BTreeSet<String> {
    let all = ontology.triples.iter();
    all.map(|triple| triple.to_string()).collect()
}

fn own() -> String {
    r#"<UANodeSet xmlns="http://opcfoundation.org/UA/2011/03/UANodeSet.xsd">
  <NamespaceUris><Uri>urn:m/</Uri></NamespaceUris>
  <Models><Model ModelUri="urn:m/" Version="2" PublicationDate="2026-01-01T00:00:00Z"><RequiredModel ModelUri="http://opcfoundation.org/UA/"/></Model></Models>
  <Aliases><Alias Alias="HasSubtype">i=45</Alias><Alias Alias="HasTypeDefinition">i=40</Alias><Alias Alias="HasComponent">i=47</Alias><Alias Alias="HasModellingRule">i=37</Alias><Alias Alias="HasInterface">i=17603</Alias><Alias Alias="Double">i=11</Alias></Aliases>
  <UAObjectType NodeId="ns=1;i=1" BrowseName="1:GripperType" IsAbstract="true"><DisplayName Locale="de">Greifer</DisplayName><References>
    <Reference ReferenceType="HasSubtype" IsForward="false">i=58</Reference><Reference ReferenceType="HasInterface">ns=1;i=9</Reference></References></UAObjectType>
  <UAVariable NodeId="ns=1;i=2" BrowseName="1:Width" DataType="Double" ValueRank="-1"><References>
    <Reference ReferenceType="HasComponent" IsForward="false">ns=1;i=1</Reference><Reference ReferenceType="HasTypeDefinition">i=63</Reference>
    <Reference ReferenceType="HasModellingRule">i=78</Reference></References><Value><Double xmlns="http://opcfoundation.org/UA/2008/02/Types.xsd">0.25</Double></Value></UAVariable>
  <UADataType NodeId="ns=1;i=3" BrowseName="1:Mode"><References><Reference ReferenceType="HasSubtype" IsForward="false">i=29</Reference></References>
    <Definition Name="1:Mode"><Field Name="Open" Value="0"/><Field Name="Shut" Value="1"/></Definition></UADataType>
  <UAReferenceType NodeId="ns=1;i=4" BrowseName="1:Holds" Symmetric="true"><InverseName>HeldBy</InverseName><References><Reference ReferenceType="HasSubtype" IsForward="false">i=32</Reference></References></UAReferenceType>
  <UAObject NodeId="ns=1;i=5" BrowseName="1:Left"><References><Reference ReferenceType="HasTypeDefinition">ns=1;i=1</Reference><Reference ReferenceType="ns=1;i=4">ns=1;s=a b</Reference><Reference ReferenceType="Unknown">i=1</Reference></References></UAObject>
  <UAVariable NodeId="ns=1;i=6" BrowseName="Names"><Value><ListOfLocalizedText xmlns="http://opcfoundation.org/UA/2008/02/Types.xsd"><LocalizedText><Text>a</Text></LocalizedText><LocalizedText><Text>b</Text></LocalizedText></ListOfLocalizedText></Value></UAVariable>
</UANodeSet>"#
        .to_owned()
}

#[test]
fn all_parts_of_a_nodeset_are_statements() {
    let ontology = Ontology::read(&own()).unwrap();
    let lines = lines(&ontology);
    let node = |id: &str| format!("<urn:m/#i={id}>");
    let ua = |id: &str| format!("<{UA}#i={id}>");
    let (is_a, own) = (
        "<http://www.w3.org/1999/02/22-rdf-syntax-ns#type>",
        "urn:ua-bridge:plant#",
    );
    let (owl, rdfs, xsd) = (
        "http://www.w3.org/2002/07/owl#",
        "http://www.w3.org/2000/01/rdf-schema#",
        "http://www.w3.org/2001/XMLSchema#",
    );
    for line in [
        format!("<urn:m/> {is_a} <{owl}Ontology>"),
        format!("<urn:m/> <{owl}imports> <{UA}>"),
        format!("{} {is_a} <{owl}Class>", node("1")),
        format!("{} <{rdfs}subClassOf> {}", node("1"), ua("58")),
        format!("{} <{rdfs}subClassOf> {}", node("1"), node("9")),
        format!("{} <{rdfs}label> \"Greifer\"@de", node("1")),
        format!("{} <{own}isAbstract> \"true\"^^<{xsd}boolean>", node("1")),
        format!("{} {} {}", node("1"), ua("47"), node("2")),
        format!("{} {is_a} {}", node("2"), ua("63")),
        format!("{} {} {}", node("2"), ua("37"), ua("78")),
        format!("{} <{own}dataType> {}", node("2"), ua("11")),
        format!("{} <{own}value> \"0.25\"^^<{xsd}double>", node("2")),
        format!("{} <{own}hasField> <urn:m/#i=3;Shut>", node("3")),
        format!("<urn:m/#i=3;Shut> <{own}value> \"1\"^^<{xsd}integer>"),
        format!("{} {is_a} <{owl}ObjectProperty>", node("4")),
        format!("{} {is_a} <{owl}SymmetricProperty>", node("4")),
        format!("{} <{rdfs}subPropertyOf> {}", node("4"), ua("32")),
        format!("{} {is_a} {}", node("5"), node("1")),
        format!("{} {} <urn:m/#s=a%20b>", node("5"), node("4")),
        format!(
            "{} <{own}valueJson> \"[{{\\\"Text\\\":\\\"a\\\"}},{{\\\"Text\\\":\\\"b\\\"}}]\"",
            node("6")
        ),
    ] {
        assert!(lines.contains(&line), "{line}\n{lines:#?}");
    }
    assert_eq!(
        ontology.findings,
        ["line 13: the reference Unknown to `i=1` is not understood"]
    );
}

/// The counts of each file are those of its XML.
#[test]
fn published_nodesets_have_all_nodes_references_fields_and_values() {
    let Some(folder) = foreign("nodesets") else {
        return;
    };
    let mut files = 0;
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_none_or(|end| end != "xml") {
            continue;
        }
        files += 1;
        let name = format!("nodesets/{}", path.file_name().unwrap().display());
        let xml = read_foreign(&name).unwrap();
        let ontology = Ontology::read(&xml).unwrap();
        assert_eq!(ontology.findings, Vec::<String>::new(), "{name}");
        let lines: Vec<String> = ontology.triples.iter().map(ToString::to_string).collect();
        let said = |part: &str| lines.iter().filter(|line| line.contains(part)).count();
        let written = |part: &str| xml.matches(part).count();
        for (what, found, expected) in [
            ("nodes", said("plant#nodeClass> "), written(" NodeId=\"")),
            ("fields", said("plant#hasField> "), written("<Field ")),
            ("models", said("owl#Ontology>"), written("<Model ")),
            ("imports", said("owl#imports> "), written("<RequiredModel ")),
            (
                "values",
                said("plant#value> \"") + said("plant#value> <") + said("plant#valueJson> ")
                    - fields_with_values(&lines),
                values(&xml),
            ),
        ] {
            assert_eq!(found, expected, "{name}: {what}");
        }
        let is_reference = |line: &&String| {
            let predicate = line.split(' ').nth(1).unwrap_or_default();
            let object = line.split(' ').nth(2).unwrap_or_default();
            let is_class = object.starts_with("<http://www.w3.org/2002/07/owl#")
                || object.starts_with("<urn:ua-bridge:plant#");
            predicate.contains("#i=")
                || predicate.ends_with("#subClassOf>")
                || predicate.ends_with("#subPropertyOf>")
                || (predicate.ends_with("#type>") && !is_class)
        };
        let references = lines.iter().filter(is_reference).count();
        assert_eq!(references, written("<Reference "), "{name}: references");
        // The store reads the Turtle. The base NodeSet would take most of the time of all tests.
        if xml.len() > 1 << 20 {
            continue;
        }
        let mut turtle = Vec::new();
        ontology.write_turtle(&mut turtle).unwrap();
        let knowledge = Knowledge::new().unwrap();
        let source = KnowledgeSource::new(SourceKind::File, &name);
        let turtle = String::from_utf8(turtle).unwrap();
        knowledge.replace_turtle(&source, &turtle, 1).unwrap();
    }
    assert!(files >= 9, "{files}");
}

fn fields_with_values(lines: &[String]) -> usize {
    let of_field = |line: &&String| {
        let subject = line.split(' ').next().unwrap_or_default();
        subject.contains(';') && line.contains("plant#value> ")
    };
    lines.iter().filter(of_field).count()
}

/// Returns the number of values of variables, which are the children of `<Value>` in a node.
fn values(xml: &str) -> usize {
    xml.matches("\n    <Value>").count()
}
