//! The skill types of a module as a NodeSet (OPC 10000-6, annex F).

use std::fmt::Write as _;

use mtp::{ModuleOutput, ParameterKind, ServiceParameter, ValueBound, unit_symbol};
use skills::{Builtin, NAMESPACE};

use super::procedure::RUN_TIME;

/// A skill type.
pub(super) struct SkillTypeXml<'a> {
    pub(super) name: String,
    pub(super) about: String,
    pub(super) parameters: Vec<&'a ServiceParameter>,
    pub(super) outputs: Vec<&'a ModuleOutput>,
    pub(super) has_run_time: bool,
}

/// A variable of a skill type.
struct VariableXml {
    name: String,
    builtin: Builtin,
    about: String,
    unit: Option<&'static str>,
    range: Option<(f64, f64)>,
    value: Option<&'static str>,
}

/// Returns the NodeSet of the skill types.
pub(super) fn nodeset(namespace: &str, skills: &[SkillTypeXml<'_>]) -> String {
    let uri = escaped(namespace);
    let mut out = format!(
        "<?xml version=\"1.0\" encoding=\"utf-8\"?>\n\
         <UANodeSet xmlns=\"http://opcfoundation.org/UA/2011/03/UANodeSet.xsd\">\n\
         <NamespaceUris><Uri>{uri}</Uri><Uri>{NAMESPACE}</Uri></NamespaceUris>\n\
         <Models><Model ModelUri=\"{uri}\" Version=\"1.0.0\">\
         <RequiredModel ModelUri=\"http://opcfoundation.org/UA/\" />\
         <RequiredModel ModelUri=\"{NAMESPACE}\" /></Model></Models>\n"
    );
    let mut id = 0;
    for skill in skills {
        skill_type(&mut out, &mut id, skill);
    }
    out.push_str("</UANodeSet>\n");
    out
}

fn skill_type(out: &mut String, id: &mut u32, skill: &SkillTypeXml<'_>) {
    *id += 1;
    let own = *id;
    let name = escaped(&skill.name);
    // Writing to a String cannot fail.
    _ = writeln!(
        out,
        "<UAObjectType NodeId=\"ns=1;i={own}\" BrowseName=\"1:{name}\">\
         <DisplayName>{name}</DisplayName><Description>{}</Description><References>\
         <Reference ReferenceType=\"i=45\" IsForward=\"false\">ns=2;i=1000</Reference>\
         </References></UAObjectType>",
        escaped(&skill.about)
    );
    let mut parameters: Vec<VariableXml> = skill
        .parameters
        .iter()
        .map(|parameter| VariableXml {
            name: parameter.name.clone(),
            builtin: builtin(parameter.kind),
            about: format!("A parameter of the module: {}", parameter.name),
            unit: unit(parameter.unit.as_ref()),
            range: range(parameter),
            value: None,
        })
        .collect();
    if skill.has_run_time {
        parameters.push(VariableXml {
            name: RUN_TIME.to_owned(),
            builtin: Builtin::Double,
            about: "Time in Execute after which the procedure is completed; 0 until Halt."
                .to_owned(),
            unit: Some("s"),
            range: None,
            value: Some("0"),
        });
    }
    let outputs: Vec<VariableXml> = skill
        .outputs
        .iter()
        .map(|output| VariableXml {
            name: output.name.clone(),
            builtin: builtin(output.kind),
            about: format!("A value that the module reports: {}", output.name),
            unit: unit(output.unit.as_ref()),
            range: None,
            value: None,
        })
        .collect();
    group(out, id, (own, "2:ParameterSet", 3), &parameters);
    group(out, id, (own, "FinalResultData", 1), &outputs);
}

fn group(
    out: &mut String,
    id: &mut u32,
    (parent, name, access): (u32, &str, u8),
    variables: &[VariableXml],
) {
    if variables.is_empty() {
        return;
    }
    *id += 1;
    let own = *id;
    let shown = name.trim_start_matches("2:");
    _ = writeln!(
        out,
        "<UAObject NodeId=\"ns=1;i={own}\" BrowseName=\"{name}\" ParentNodeId=\"ns=1;i={parent}\">\
         <DisplayName>{shown}</DisplayName><References>\
         <Reference ReferenceType=\"i=40\">i=58</Reference>\
         <Reference ReferenceType=\"i=37\">i=78</Reference>\
         <Reference ReferenceType=\"i=47\" IsForward=\"false\">ns=1;i={parent}</Reference>\
         </References></UAObject>"
    );
    for variable in variables {
        self::variable(out, id, (own, access), variable);
    }
}

fn variable(out: &mut String, id: &mut u32, (parent, access): (u32, u8), variable: &VariableXml) {
    *id += 1;
    let own = *id;
    let name = escaped(&variable.name);
    let definition = match (variable.unit, variable.range) {
        (None, None) => "i=63",
        (Some(_), None) => "i=17497",
        (None, Some(_)) => "i=2368",
        (Some(_), Some(_)) => "i=17570",
    };
    let builtin = variable.builtin;
    let value = variable.value.map(|value| {
        let element = builtin.name();
        format!("<Value><{element} xmlns=\"{TYPES}\">{value}</{element}></Value>")
    });
    _ = writeln!(
        out,
        "<UAVariable NodeId=\"ns=1;i={own}\" BrowseName=\"1:{name}\" \
         ParentNodeId=\"ns=1;i={parent}\" DataType=\"i={}\" AccessLevel=\"{access}\" \
         UserAccessLevel=\"{access}\"><DisplayName>{name}</DisplayName>\
         <Description>{}</Description><References>\
         <Reference ReferenceType=\"i=40\">{definition}</Reference>\
         <Reference ReferenceType=\"i=37\">i=78</Reference>\
         <Reference ReferenceType=\"i=47\" IsForward=\"false\">ns=1;i={parent}</Reference>\
         </References>{}</UAVariable>",
        builtin.id(),
        escaped(&variable.about),
        value.unwrap_or_default()
    );
    if let Some(unit) = variable.unit {
        let unit = escaped(unit);
        let body = format!(
            "<EUInformation><NamespaceUri>urn:ua-bridge:units</NamespaceUri><UnitId>-1</UnitId>\
             <DisplayName><Text>{unit}</Text></DisplayName>\
             <Description><Text>{unit}</Text></Description></EUInformation>"
        );
        property(out, id, own, ("EngineeringUnits", "i=887", "i=888", &body));
    }
    if let Some((low, high)) = variable.range {
        let body = format!("<Range><Low>{low}</Low><High>{high}</High></Range>");
        property(out, id, own, ("EURange", "i=884", "i=885", &body));
    }
}

fn property(
    out: &mut String,
    id: &mut u32,
    parent: u32,
    (name, data_type, encoding, body): (&str, &str, &str, &str),
) {
    *id += 1;
    let own = *id;
    _ = writeln!(
        out,
        "<UAVariable NodeId=\"ns=1;i={own}\" BrowseName=\"{name}\" ParentNodeId=\"ns=1;i={parent}\" \
         DataType=\"{data_type}\"><DisplayName>{name}</DisplayName><References>\
         <Reference ReferenceType=\"i=40\">i=68</Reference>\
         <Reference ReferenceType=\"i=37\">i=78</Reference>\
         <Reference ReferenceType=\"i=46\" IsForward=\"false\">ns=1;i={parent}</Reference>\
         </References><Value><ExtensionObject xmlns=\"{TYPES}\">\
         <TypeId><Identifier>{encoding}</Identifier></TypeId><Body>{body}</Body>\
         </ExtensionObject></Value></UAVariable>"
    );
}

pub(super) const fn builtin(kind: ParameterKind) -> Builtin {
    match kind {
        // A Double takes each number of a user exactly; the module has a Float.
        ParameterKind::Analog => Builtin::Double,
        ParameterKind::Integer => Builtin::Int32,
        ParameterKind::Binary => Builtin::Boolean,
        ParameterKind::Text => Builtin::String,
    }
}

pub(super) fn unit(bound: Option<&ValueBound>) -> Option<&'static str> {
    bound.and_then(ValueBound::constant).and_then(unit_symbol)
}

/// Returns the range of a parameter with both limits in the file.
pub(super) fn range(parameter: &ServiceParameter) -> Option<(f64, f64)> {
    let low = parameter.min.as_ref()?.constant()?;
    let high = parameter.max.as_ref()?.constant()?;
    (low < high).then_some((low, high))
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
        .replace('"', "&quot;")
}

const TYPES: &str = "http://opcfoundation.org/UA/2008/02/Types.xsd";
