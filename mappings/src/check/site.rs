//! Positions of bindings in the document, and their fields beside the type of the variable.

use messages::{Dialect, Leaf, TypeName};

use super::names::{mended, topic_fault};
use super::types::{self, ValueType, dialect, told};
use crate::code::Code;
use crate::findings::MappingFindings;
use crate::read::short;
use crate::topic::{SpaceId, TopicId};
use crate::tree::TextSpan;

/// Variable of the bindings that are checked.
pub(super) struct BoundVariable {
    pub(super) topic: Option<TopicId>,
    pub(super) origin: Option<SpaceId>,
    pub(super) declared: Option<ValueType>,
    /// The variable has a `type`, which is not a value type.
    pub(super) type_faulty: bool,
}

/// Position of a binding in the document.
pub(super) struct BindingSite<'s> {
    pub(super) place: TextSpan,
    pub(super) space: Option<SpaceId>,
    pub(super) subject: &'s BoundVariable,
}

impl BindingSite<'_> {
    pub(super) fn dialect(&self) -> Dialect {
        self.space.map_or(Dialect::Ros1, dialect)
    }
}

/// Returns `None` for a text that is not the name of a topic or service, which is noted.
pub(super) fn ros_name(
    text: &str,
    place: TextSpan,
    (dialect, what): (Dialect, &str),
    findings: &mut MappingFindings,
) -> Option<()> {
    if let Some(fault) = topic_fault(text, dialect) {
        let note = findings
            .error(
                Code::RosTopic,
                place,
                format!("`{}` is not a ROS {what} name", short(text)),
            )
            .label(fault);
        if let Some(mended) = mended(text, dialect) {
            note.help(format!("did you mean `{mended}`?"));
        }
        return None;
    }
    Some(())
}

pub(super) const fn ros(dialect: Dialect) -> &'static str {
    match dialect {
        Dialect::Ros1 => "ROS 1",
        Dialect::Ros2 => "ROS 2",
    }
}

/// Notes fields that are not of the type of the variable.
pub(super) fn compare(
    fields: &[Leaf],
    name: &TypeName,
    subject: &BoundVariable,
    place: TextSpan,
    findings: &mut MappingFindings,
) {
    let Some(declared) = subject.declared else {
        return;
    };
    let told_type = types::print(declared);
    match fields {
        [one] if types::value_type(one) == declared => {}
        [one] if *one == Leaf::bytes() => {
            let message = format!("the variable is {told_type}, but bytes are a ByteString");
            findings
                .error(Code::TypeDiffers, place, message)
                .help("remove the `type` of the variable, or write `type: ByteString`");
        }
        [one] => {
            let found = types::print(types::value_type(one));
            let message = format!(
                "the variable is {told_type}, but `{}` of `{name}` is {found}",
                one.path
            );
            let help = format!("remove the `type` of the variable, or write `type: {found}`");
            findings.error(Code::TypeDiffers, place, message).help(help);
        }
        several => {
            let paths: Vec<&str> = several.iter().map(|leaf| leaf.path.as_str()).collect();
            let message = format!(
                "the variable is a single {told_type}, but `{name}` has {} fields",
                several.len()
            );
            let help = format!(
                "bind one `field` of {}, or remove the `type` of the variable",
                told(&paths)
            );
            findings.error(Code::TypeDiffers, place, message).help(help);
        }
    }
}
