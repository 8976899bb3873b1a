//! Fuzzes NodeSet2 files with arbitrary bytes.

use opcua::server::address_space::AddressSpace;
use opcua::types::NamespaceMap;
use plant_opcua::nodeset::{ImportedNodeSets, NodeSetError};

/// Imports a file, which succeeds or gives a fatal finding. Each finding has a line of the file,
/// and imported nodes exist in the address space.
pub fn nodeset(input: &[u8]) {
    let (sets, faults) = ImportedNodeSets::of_document("fuzz.xml", input);
    let is_fatal = faults.iter().any(|fault| fault.error.is_fatal());
    assert!(faults.len() <= input.len() + 1, "findings are bounded");
    // A file has no more lines than bytes.
    for fault in &faults {
        if let NodeSetError::Node { line, .. } | NodeSetError::Unread { line, .. } = &fault.error {
            assert!((1..=input.len() + 1).contains(line), "{fault:?}");
        }
    }
    if is_fatal {
        assert!(sets.is_empty());
        return;
    }
    let (mut space, mut namespaces) = (AddressSpace::new(), NamespaceMap::new());
    match sets.import(&mut space, &mut namespaces) {
        Ok(imported) => {
            assert!(imported.unread.len() <= imported.nodes.len());
            for node in &imported.nodes {
                assert!(space.find(node).is_some(), "{node}");
            }
        }
        // The library leaves out nodes, for example if their ArrayDimensions are not numbers.
        Err(error) => assert!(matches!(error, NodeSetError::Values { .. }), "{error}"),
    }
    if let Ok(text) = xml_text::decode(input) {
        drop(knowledge::nodeset::read(&text));
    }
}
