//! References from composite skills to the skills of other components that they use.

use std::collections::BTreeMap;

use plant_opcua::server::{IdRange, InstanceError, InstanceSpec, ObjectSpec, OpcUaServer};
use plant_opcua::types::{NodeId, ObjectTypeId, QualifiedName, ReferenceTypeId};

use crate::model::{NAMESPACE, USED_SKILL_TYPE, USES_SKILL};

/// Shows the skills that each skill uses, as `<component> <type>`. Each used skill has an object
/// below the folder `UsedSkills` of the component, and a reference leads to it.
pub(super) fn show(
    server: &OpcUaServer,
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
                        // The node exists as long as the server.
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
