//! Roles and their permissions in the document.

use crate::read::{FromNode, Located, NodeReader, choice, document, inline_schema};
use crate::tree::{YamlKind, YamlNode};

document! {
    /// Permissions of roles for a variable.
    struct PermissionsEntry {
        /// Roles that may read it, a single role or a list; default every user.
        read: RoleList,
        /// Roles that may write it, with `origin: 0`; default [operator, engineer].
        write: RoleList,
    }

    /// Permissions of roles for a call.
    struct CallPermissionsEntry {
        /// Roles that may call the Method, a single role or a list; default [operator, engineer].
        call: RoleList,
    }
}

choice! {
    enum RoleEntry {
        /// Reads values.
        Observer = "observer",
        /// Runs the cell.
        Operator = "operator",
        /// Configures the cell.
        Engineer = "engineer",
        /// Manages users and permissions.
        SecurityAdmin = "security_admin",
    }
}

/// A role or a list of roles.
#[derive(Clone, Debug)]
pub(crate) struct RoleList(pub(crate) Vec<Located<RoleEntry>>);

impl FromNode for RoleList {
    fn read(node: &YamlNode<'_>, reader: &mut NodeReader<'_>) -> Option<Self> {
        let is_one = matches!(node.kind, YamlKind::Scalar(_));
        let wanted = "a role such as `engineer`, or a list of them";
        reader.one_or_list(node, is_one, wanted).map(Self)
    }
}

inline_schema!(RoleList, generator => {
    let one = generator.subschema_for::<RoleEntry>();
    schemars::json_schema!({ "anyOf": [one, { "type": "array", "items": one, "minItems": 1 }] })
});
