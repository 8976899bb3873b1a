//! Unit tests of `call_announcement`.

use uadp::discovery::{StructureDefinition, StructureField};
use uadp::{BuiltinType, NetworkMessage};

use super::*;

#[test]
fn what_is_announced_of_a_call_is_what_is_read_of_it() {
    let description = CallDescription {
        name: "gripper.Grasp.Start".to_owned(),
        about: "closes".to_owned(),
        role: CallRole::Goal(ActionFamily::behind(105).unwrap()),
        request: vec![
            CallField::scalar("Force", BuiltinType::Double).optional(),
            CallField::array("Position", BuiltinType::Float),
        ],
        response: vec![CallField::scalar("success", BuiltinType::Boolean)],
    };
    let topic: TopicId = "ua_0_7_105".parse().unwrap();
    let utc = Timestamp::from_unix_nanos(1_700_000_000_000_000_000);
    let announcement = CallAnnouncement::new(
        topic,
        (&description, None, &BTreeMap::new(), 4711),
        None,
        utc,
    )
    .unwrap();
    let mut bytes = Vec::new();
    // A redundant bridge has another ActionTargetId in each term.
    announcement.write((3, 4712), &mut bytes);
    let message = NetworkMessage::decode(&bytes).unwrap();
    let announced = Announcement::decode(&message).unwrap();
    assert_eq!(announced.sequence_number, 3);
    let AnnouncedContent::ActionMetaData(action) = announced.announced else {
        unreachable!("{announced:?}");
    };
    assert_eq!(action.writer_id, 105);
    let (named, name) = crate::split_name(action.name().unwrap()).unwrap();
    assert_eq!(named, topic);
    assert_eq!(read(&action, name), Ok((description, 4712)));
}

#[test]
fn structures_of_structures_are_believed_up_to_a_size() {
    let names: Vec<String> = (0..20).map(|at| format!("S{at}")).collect();
    let of = |name| NodeId::string(2, name);
    let fields: Vec<Vec<StructureField<'_>>> = (0..names.len())
        .map(|at| {
            let inner = at.checked_sub(1).map(|inner| of(&names[inner][..]));
            let field = |name| StructureField {
                name: Some(name),
                data_type: inner.unwrap_or_else(|| NodeId::numeric(0, 11)),
                value_rank: -1,
                ..StructureField::default()
            };
            vec![field("left"), field("right")]
        })
        .collect();
    let described: Vec<StructureDescription<'_>> = names
        .iter()
        .zip(&fields)
        .map(|(name, fields)| StructureDescription {
            data_type_id: of(name),
            name: named_in(2, name),
            structure_definition: StructureDefinition {
                default_encoding_id: of(name),
                fields: WireArray::new(fields),
                ..StructureDefinition::default()
            },
        })
        .collect();
    let schema = DataTypeSchemaHeader {
        structure_data_types: WireArray::new(&described),
        ..DataTypeSchemaHeader::default()
    };
    let known = read_structures(&schema);
    let counts: Vec<usize> = known.iter().map(|(_, (_, count))| *count).collect();
    // Each structure has two fields, each of which contains the previous structure.
    assert_eq!(counts[..3], [2, 6, 14]);
    assert_eq!((known.len(), counts[10]), (11, 4094), "{counts:?}");
}

fn named_in(namespace: u16, name: &str) -> QualifiedName<'_> {
    QualifiedName {
        namespace,
        name: Some(name),
    }
}

#[test]
fn the_structures_of_a_service_are_read_with_those_in_them() {
    let registry = messages::TypeRegistry::bundle(messages::Dialect::Ros1);
    let name = "nav_msgs/GetPlan".parse().unwrap();
    let service = registry.service(&name).unwrap();
    let (request, response) = (service.request(), service.response());
    let of = |message: &MessageType| message.leaves().iter().map(CallField::of).collect();
    let description = CallDescription {
        name: String::new(),
        about: String::new(),
        role: CallRole::Call,
        request: of(request),
        response: of(response),
    };
    let topic: TopicId = "ua_2_3_7".parse().unwrap();
    let types = CallTypes { request, response };
    let said = (&description, Some(types), &BTreeMap::new(), LASTING_TARGET);
    let utc = Timestamp::from_unix_nanos(1_700_000_000_000_000_000);
    let announcement = CallAnnouncement::new(topic, said, None, utc).unwrap();
    let mut bytes = Vec::new();
    announcement.write((3, LASTING_TARGET), &mut bytes);
    let message = NetworkMessage::decode(&bytes).unwrap();
    let AnnouncedContent::ActionMetaData(action) =
        Announcement::decode(&message).unwrap().announced
    else {
        unreachable!();
    };
    let (heard, _) = read(&action, "").unwrap();
    let poses = heard
        .response
        .iter()
        .find(|field| field.name == "plan.poses");
    let stamped = poses.and_then(|field| field.structure.clone()).unwrap();
    assert_eq!(stamped.name, "geometry_msgs/PoseStamped");
    let inner: Vec<(&str, BuiltinType)> = stamped
        .fields
        .iter()
        .map(|field| (&field.name[..], field.builtin))
        .collect();
    let structure = BuiltinType::ExtensionObject;
    assert_eq!(inner, [("header", structure), ("pose", structure)]);
    let pose = stamped.fields[1].structure.as_ref().unwrap();
    let position = pose.fields[0].structure.as_ref().unwrap();
    assert_eq!(
        (&position.name[..], position.fields.len()),
        ("geometry_msgs/Point", 3)
    );
    assert!(heard.request.iter().all(|field| field.structure.is_none()));
}
