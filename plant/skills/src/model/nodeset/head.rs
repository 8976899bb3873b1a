//! The head of a NodeSet2 document: its namespaces, its model and its aliases.

use super::NAMESPACE;

/// Returns the head of the document: of the model with the URI of the namespace, or of another
/// model, which extends it.
pub(super) fn head(extension: Option<&str>) -> String {
    let uri = |uri: &str| format!("    <Uri>{uri}</Uri>\n");
    let (uris, model, required) = match extension {
        None => (uri(NAMESPACE), NAMESPACE, String::new()),
        Some(model) => (
            uri(NAMESPACE) + &uri(model),
            model,
            format!("      <RequiredModel ModelUri=\"{NAMESPACE}\" {VERSION} />\n"),
        ),
    };
    let head = HEAD.replace("{URIS}", &uris).replace("{MODEL}", model);
    let head = head.replace("{VERSION}", VERSION);
    head.replace("{REQUIRED}", &required)
}

/// The version of the models.
const VERSION: &str = r#"Version="0.1.0" PublicationDate="2026-11-25T00:00:00Z""#;
const HEAD: &str = r#"<?xml version="1.0" encoding="utf-8"?>
<UANodeSet xmlns="http://opcfoundation.org/UA/2011/03/UANodeSet.xsd" LastModified="2026-11-25T00:00:00Z">
  <NamespaceUris>
{URIS}  </NamespaceUris>
  <Models>
    <Model ModelUri="{MODEL}" {VERSION}>
      <RequiredModel ModelUri="http://opcfoundation.org/UA/" Version="1.05.02" PublicationDate="2022-11-01T00:00:00Z" />
{REQUIRED}    </Model>
  </Models>
  <Aliases>
    <Alias Alias="Boolean">i=1</Alias>
    <Alias Alias="UInt16">i=5</Alias>
    <Alias Alias="Int32">i=6</Alias>
    <Alias Alias="UInt32">i=7</Alias>
    <Alias Alias="Float">i=10</Alias>
    <Alias Alias="Double">i=11</Alias>
    <Alias Alias="String">i=12</Alias>
    <Alias Alias="HasModellingRule">i=37</Alias>
    <Alias Alias="HasTypeDefinition">i=40</Alias>
    <Alias Alias="GeneratesEvent">i=41</Alias>
    <Alias Alias="HasSubtype">i=45</Alias>
    <Alias Alias="HasProperty">i=46</Alias>
    <Alias Alias="HasComponent">i=47</Alias>
    <Alias Alias="HasDictionaryEntry">i=17597</Alias>
  </Aliases>
"#;
