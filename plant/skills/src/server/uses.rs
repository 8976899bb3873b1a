//! Which skills of other components those of this one are made of, as references.

use std::collections::BTreeMap;

use plant_opcua::server::{IdRange, InstanceError, InstanceSpec, ObjectSpec, Server};
use plant_opcua::types::{NodeId, ObjectTypeId, QualifiedName, ReferenceTypeId};

use crate::model::{NAMESPACE, USED_SKILL_TYPE, USES_SKILL};

/// Shows what each skill uses, as `<component> <type>`: an object below the folder `UsedSkills` of the component, one for each
/// that is used, and a reference to it.
pub(super) fn show(
    server: &Server,
    component: &NodeId,
    used: &[(NodeId, Vec<String>)],
    ids: &mut IdRange,
) -> Result<(), InstanceError> {
    let none = || InstanceError::NoType(NodeId::null());
    let type_id = server
        .find_type(NAMESPACE, USED_SKILL_TYPE)
        .ok_or_else(none)?;
    let reference = server.find_type(NAMESPACE, USES_SKILL).ok_or_else(none)?;
    if used.iter().all(|(_, uses)| uses.is_empty()) {
        return Ok(());
    }
    let own = component.namespace;
    let folder = ObjectSpec {
        node_id: ids.next(),
        browse_name: QualifiedName::new(own, "UsedSkills"),
        display_name: "UsedSkills".into(),
        type_definition: ObjectTypeId::FolderType.into(),
        parent: component.clone(),
        reference: ReferenceTypeId::HasComponent.into(),
        event_notifier: false,
    };
    server.add_object(&folder)?;
    let mut made: BTreeMap<&str, NodeId> = BTreeMap::new();
    for (skill, uses) in used {
        for text in uses {
            if !made.contains_key(text.as_str()) {
                let spec = InstanceSpec::new(
                    type_id.clone(),
                    ids.next(),
                    QualifiedName::new(own, text.as_str()),
                    folder.node_id.clone(),
                );
                let object = server.instantiate(&spec, &mut |_| ids.next())?;
                let (component, of_type) = text.split_once(' ').unwrap_or(("", text));
                for (name, value) in [("Component", component), ("Type", of_type)] {
                    if let Some(node) = object.node(name) {
                        // The node is ours for as long as the server is there.
                        let _shown = server.show(node, value);
                    }
                }
                made.insert(text, object.node_id);
            }
            if let Some(object) = made.get(text.as_str()) {
                server.add_reference(skill, &reference, object);
            }
        }
    }
    Ok(())
}
