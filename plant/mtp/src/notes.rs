//! Notes about the elements of a manifest that have no place in the model.

use std::collections::BTreeMap;

use crate::caex::CaexElement;
use crate::model::MtpFinding;
use crate::picture::is_picture;
use crate::read::{is_assembly, is_list, is_parameter, is_procedure};

/// Returns a note for each kind of elements that have no place in the model. `of_pictures` are such
/// elements in pictures.
pub(crate) fn notes<'a>(
    root: &'a CaexElement,
    of_pictures: Vec<&'a CaexElement>,
) -> impl Iterator<Item = MtpFinding> {
    let mut kinds: BTreeMap<&str, (usize, usize)> = BTreeMap::new();
    let mut count = |path: &'a str, line: usize| {
        let known = kinds.entry(path).or_insert((0, line));
        known.0 += 1;
        known.1 = known.1.min(line);
    };
    for element in of_pictures {
        count(&element.path, element.line);
    }
    let mut waiting = vec![(root, false)];
    while let Some((element, is_in_list)) = waiting.pop() {
        if is_picture(element) {
            continue;
        }
        for link in &element.links {
            count("InternalLink", link.line);
        }
        let is_read = READ.contains(&element.kind())
            || is_procedure(element)
            || is_parameter(element)
            || is_assembly(element, is_in_list)
            || (element.path.is_empty() && !element.is_interface);
        if !is_read {
            count(&element.path, element.line);
        }
        let is_list = is_list(element);
        waiting.extend(element.children.iter().map(|child| (child, is_list)));
    }
    kinds.into_iter().map(|(path, (count, line))| {
        let about = if path.is_empty() {
            "an element without a class"
        } else {
            path
        };
        MtpFinding {
            about: about.to_owned(),
            what: format!("not read ({count} in the file)"),
            line,
            is_note: true,
        }
    })
}

/// Kinds of elements that the model has, or whose children it has.
const READ: &[&str] = &[
    "Alarm",
    "AlarmGroup",
    "AlarmMessage",
    "AlarmSet",
    "AlarmText",
    "AspectSetReference",
    "CommunicationSet",
    "DataAssemblySet",
    "ExternalDataConnector",
    "HMISet",
    "InstanceList",
    "ModuleTypePackage",
    "OPCUAItem",
    "OPCUAServer",
    "ProcessValueIn",
    "ProcessValueOut",
    "ProcessValueSet",
    "ReportValue",
    "RequiredEquipment",
    "ServerAssemblySet",
    "Service",
    "ServiceSet",
    "ServicesSet",
    "SourceList",
    "TextSet",
];
