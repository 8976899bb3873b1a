//! Fuzzes message definitions with arbitrary text.

use std::sync::Arc;

use messages::{
    Dialect, MessagePlan, MessageType, Selection, TextKind, TypeName, TypeRegistry, Wire,
};

/// Parses a definition. The first byte selects the kind of text: `m` a .msg, `s` a .srv, `a` an
/// .action of ROS 1, in capitals of ROS 2, `I` an .idl of each of the three, and `f` the full
/// definition of a ROS 1 connection header.
///
/// A parsed type has a definition that parses to the same type. For the definition of a connection
/// header, missing types are taken from the bundle both times.
pub fn definition(input: &[u8]) {
    let Some((kind, text)) = input.split_first() else {
        return;
    };
    let Ok(text) = std::str::from_utf8(text) else {
        return;
    };
    let name: TypeName = "fuzz_msgs/Any".parse().expect("a name");
    let dialect = if kind.is_ascii_uppercase() {
        Dialect::Ros2
    } else {
        Dialect::Ros1
    };
    let mut registry = TypeRegistry::bundle(dialect);
    match kind.to_ascii_lowercase() {
        b'm' => {
            if registry.add(&name, text).is_ok()
                && let Ok(made) = registry.get(&name)
            {
                check(&made, TypeRegistry::empty(dialect));
            }
        }
        b's' => {
            if registry.add_service(&name, text).is_ok()
                && let Ok(made) = registry.service(&name)
            {
                check(made.request(), TypeRegistry::empty(dialect));
                check(made.response(), TypeRegistry::empty(dialect));
            }
        }
        b'a' => {
            // ROS 1 and ROS 2 derive different messages from the same action definition.
            if registry.add_action(&name, text).is_err() {
                return;
            }
            if let Ok(made) = registry.action(&name) {
                for part in [made.goal(), made.result(), made.feedback(), made.action()] {
                    check(part, TypeRegistry::empty(dialect));
                }
            }
            if let Ok(made) = registry.action_messages(&name) {
                for part in [made.goal(), made.result_response(), made.feedback()] {
                    check(part, TypeRegistry::empty(dialect));
                }
            }
        }
        b'i' => idl(&mut registry, &name, text),
        b'f' => {
            if let Ok(made) = registry.add_ros1_definition(&name, text) {
                check(&made, TypeRegistry::bundle(dialect));
            }
        }
        _ => {}
    }
}

/// Parses an .idl of any kind. The description of a message must give the same message.
fn idl(registry: &mut TypeRegistry, name: &TypeName, text: &str) {
    for kind in TextKind::ALL {
        let taken = registry.add_idl(kind, name, text).is_ok();
        assert!(
            !taken || registry.dialect() == Dialect::Ros2,
            "ROS 1 has no IDL"
        );
    }
    if let Ok(made) = registry.get(name) {
        check(&made, TypeRegistry::empty(registry.dialect()));
        let hash = registry
            .type_hash(name)
            .expect("a type that is known has a hash");
        let described = registry.describe(name).expect("and a description");
        let again = TypeRegistry::empty(Dialect::Ros2).add_described(name, &described, hash);
        assert_eq!(again.expect("of that hash").leaves(), made.leaves());
    }
    if let Ok(made) = registry.service(name) {
        check(made.request(), TypeRegistry::empty(registry.dialect()));
    }
    if let Ok(made) = registry.action_messages(name) {
        check(made.goal(), TypeRegistry::empty(registry.dialect()));
    }
}

/// Checks a type; `others` has the types that its definition lacks.
fn check(made: &Arc<MessageType>, mut others: TypeRegistry) {
    assert!(made.leaves().len() <= 4096, "flattening is bounded");
    let wire = match made.dialect() {
        Dialect::Ros1 => Wire::Ros1,
        Dialect::Ros2 => Wire::Cdr,
    };
    // Arrays of messages without fields have no plan and give an error.
    if let Ok(plan) = MessagePlan::compile(made, &Selection::Whole, wire) {
        assert_eq!(plan.leaves(), made.leaves());
    }
    for leaf in made.leaves().iter().take(8) {
        let selection = Selection::Field(leaf.path.clone());
        if let Ok(plan) = MessagePlan::compile(made, &selection, wire) {
            assert_eq!(plan.leaves().len(), 1, "{}", leaf.path);
        }
    }
    if made.dialect() == Dialect::Ros1 {
        let again = others
            .add_ros1_definition(made.name(), made.definition())
            .expect("a definition names all it needs");
        assert_eq!(again.md5(), made.md5());
        assert_eq!(again.leaves(), made.leaves());
    }
}
