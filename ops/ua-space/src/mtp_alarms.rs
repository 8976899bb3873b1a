//! `ua-space mtp alarms`: the alarms of a manifest as variables of a mapping, whose conditions
//! `ua-server` shows.

use std::collections::BTreeSet;
use std::io::{self, Write as _};

use ::mtp::pea::{Pea, PeaValue};
use ::mtp::{Module, ModuleAlarm, OpcUaNode};

use crate::arguments::MtpAlarms;
use crate::exit::CommandFailure;
use crate::live::{harmless, json};

/// Prints the part of a mapping with the alarms of a manifest.
pub(crate) fn alarms(arguments: &MtpAlarms) -> Result<(), CommandFailure> {
    let module = crate::manifest::read(&arguments.file)?;
    let part = AlarmMapping::of(&module, arguments)?;
    let mut out = io::stdout().lock();
    out.write_all(part.yaml(&module)?.as_bytes())?;
    out.flush()?;
    Ok(())
}

/// The servers and variables of a mapping.
#[derive(Debug, Default)]
struct AlarmMapping {
    /// Names and endpoints.
    servers: Vec<(String, String)>,
    variables: Vec<AlarmVariable>,
    /// The alarms without a variable, with the reason.
    left_out: Vec<String>,
}

/// A variable with an alarm.
#[derive(Debug, PartialEq)]
struct AlarmVariable {
    node: String,
    name: String,
    data_type: &'static str,
    server: String,
    source: String,
    when: String,
    severity: Option<u16>,
    message: String,
}

impl AlarmMapping {
    fn of(module: &Module, arguments: &MtpAlarms) -> Result<Self, CommandFailure> {
        let pea = Pea::new(module);
        let mut part = Self::default();
        let mut names = BTreeSet::new();
        for (id, alarm) in (arguments.first..=u16::MAX).zip(&module.alarms) {
            let (trigger, value) = match trigger(alarm, &pea) {
                Ok(found) => found,
                Err(why) => {
                    part.left_out.push(format!("{}: {why}", alarm.name));
                    continue;
                }
            };
            let server = part.server(module, trigger, arguments)?;
            let plain = format!("{}.{}", module.name, alarm.name);
            let name = if names.insert(plain.clone()) {
                plain
            } else {
                format!("{plain} ({})", alarm.id)
            };
            let (data_type, when) = value;
            part.variables.push(AlarmVariable {
                node: format!("ns={};i={id}", arguments.namespace),
                name,
                data_type,
                server,
                source: trigger.id(),
                when,
                severity: alarm.severity.filter(|one| (1..=1000).contains(one)),
                message: alarm.text.chars().take(LONGEST_MESSAGE).collect(),
            });
        }
        let room = usize::from(u16::MAX - arguments.first) + 1;
        if module.alarms.len() > room {
            let why = format!("{} alarms do not fit behind --first", module.alarms.len());
            return Err(CommandFailure::Data(why));
        }
        Ok(part)
    }

    /// Returns the name of the server of a node.
    fn server(
        &mut self,
        module: &Module,
        node: &OpcUaNode,
        arguments: &MtpAlarms,
    ) -> Result<String, CommandFailure> {
        let endpoint = arguments.endpoint.as_ref().unwrap_or(&node.endpoint);
        if endpoint.is_empty() {
            let why = "the manifest names no endpoint: give one (--endpoint)".to_owned();
            return Err(CommandFailure::Data(why));
        }
        if let Some((name, _)) = self.servers.iter().find(|(_, known)| known == endpoint) {
            return Ok(name.clone());
        }
        let name = match self.servers.len() {
            0 => module.name.clone(),
            others => format!("{}-{}", module.name, others + 1),
        };
        self.servers.push((name.clone(), endpoint.clone()));
        Ok(name)
    }

    /// Returns the text. Texts of the manifest are quoted as in JSON, which YAML reads too.
    fn yaml(&self, module: &Module) -> Result<String, CommandFailure> {
        let mut text = format!(
            "# Alarms of the process module {}: a part of the mapping of ua-server.\n",
            harmless(&module.name)
        );
        if self.variables.is_empty() && self.left_out.is_empty() {
            text.push_str("# The manifest has no alarms.\n");
        }
        for why in &self.left_out {
            text.push_str(&format!("# left out: {}\n", harmless(why)));
        }
        if self.variables.is_empty() {
            return Ok(text);
        }
        text.push_str("servers:\n");
        for (name, endpoint) in &self.servers {
            let (name, endpoint) = (json(name)?, json(endpoint)?);
            text.push_str(&format!("  - {{name: {name}, endpoint: {endpoint}}}\n"));
        }
        text.push_str("variables:\n");
        for row in &self.variables {
            let mut alarm = format!("when: {}", row.when);
            if let Some(severity) = row.severity {
                alarm.push_str(&format!(", severity: {severity}"));
            }
            if !row.message.trim().is_empty() {
                alarm.push_str(&format!(", message: {}", json(&row.message)?));
            }
            text.push_str(&format!(
                "  - node: {}\n    name: {}\n    type: {}\n    origin: 0\n    \
                 from: {{server: {}, node: {}}}\n    alarm: {{{alarm}}}\n",
                row.node,
                json(&row.name)?,
                row.data_type,
                json(&row.server)?,
                json(&row.source)?,
            ));
        }
        Ok(text)
    }
}

/// The OPC UA type of a trigger, and its value as YAML.
type TriggerValue = (&'static str, String);

/// The reason why an alarm of a module has no condition.
#[derive(Debug, thiserror::Error)]
enum NoCondition {
    #[error("its Trigger names no node of the manifest")]
    NoNode,
    #[error("its TriggerValue `{text}` is not {expected}")]
    Value {
        text: String,
        expected: &'static str,
    },
    #[error("its TriggerValue cannot be written: {0}")]
    Text(CommandFailure),
    #[error(
        "its trigger is an analog value, and the manifest does not say whether the alarm is above or \
         below {text}: write a variable of {node} with `high` or `low`"
    )]
    Analog { text: String, node: String },
}

/// Returns the node of an alarm, its type, and the value that activates the alarm.
fn trigger<'a>(
    alarm: &'a ModuleAlarm,
    pea: &Pea,
) -> Result<(&'a OpcUaNode, TriggerValue), NoCondition> {
    let node = alarm.trigger.as_ref().ok_or(NoCondition::NoNode)?;
    let text = alarm.trigger_value.trim();
    let number = |expected| NoCondition::Value {
        text: text.to_owned(),
        expected,
    };
    let value = match pea.value(&node.item) {
        Some(PeaValue::Boolean(_)) | None => match text.to_ascii_lowercase().as_str() {
            "" | "true" | "1" => ("Boolean", "true".to_owned()),
            "false" | "0" => ("Boolean", "false".to_owned()),
            _ => return Err(number("true or false")),
        },
        Some(PeaValue::Byte(_)) => {
            let value: u8 = text.parse().map_err(|_| number("a number from 0 to 255"))?;
            ("Byte", value.to_string())
        }
        Some(PeaValue::Word(_)) => {
            let value: u32 = text.parse().map_err(|_| number("a number of 32 bits"))?;
            ("UInt32", value.to_string())
        }
        Some(PeaValue::Integer(_)) => {
            let value: i32 = text.parse().map_err(|_| number("a number of 32 bits"))?;
            ("Int32", value.to_string())
        }
        Some(PeaValue::Text(_)) => {
            let value = json(&text).map_err(NoCondition::Text)?;
            ("String", value)
        }
        Some(PeaValue::Number(_)) => {
            let (text, node) = (text.to_owned(), node.id());
            return Err(NoCondition::Analog { text, node });
        }
    };
    Ok((node, value))
}

/// Longest message of an alarm in characters.
const LONGEST_MESSAGE: usize = 1_000;

#[cfg(test)]
mod tests {
    use mappings::Mapping;
    use type_files::Disk;

    use super::*;
    use crate::manifest::column;

    fn arguments() -> MtpAlarms {
        MtpAlarms {
            file: String::new(),
            namespace: 3,
            first: 100,
            endpoint: Some("opc.tcp://127.0.0.1:4855".to_owned()),
        }
    }

    /// Returns a module with an alarm for a value of a node of that type.
    fn with_trigger(is_wanted: impl Fn(&PeaValue) -> bool, value: &str) -> Module {
        let mut module = column();
        let pea = Pea::new(&module);
        let (item, _) = pea.values().find(|(_, value)| is_wanted(value)).unwrap();
        let item = module.items.iter().find(|one| one.node.item == item);
        let node = item.unwrap().node.clone();
        let mut alarm = module.alarms[0].clone();
        alarm.trigger = Some(node);
        alarm.trigger_value = value.to_owned();
        module.alarms = vec![alarm];
        module
    }

    #[test]
    fn an_alarm_of_a_manifest_is_a_variable_that_a_mapping_accepts() {
        let module = with_trigger(|value| matches!(value, PeaValue::Word(_)), "16");
        let part = AlarmMapping::of(&module, &arguments()).unwrap();
        let row = &part.variables[0];
        assert_eq!(
            (&*row.node, row.data_type, &*row.when, row.severity),
            ("ns=3;i=100", "UInt32", "16", Some(700))
        );
        assert_eq!(row.message, "The column is almost full");
        let text = part.yaml(&module).unwrap();
        let whole = format!("namespaces: {{3: 'urn:ua-bridge:test'}}\n{text}");
        let checked = Mapping::from_text(&whole, "cell.yaml", &Disk);
        let told = checked.render_all();
        let mapping = checked.mapping.expect(&told);
        assert!(mapping.variables()[0].alarm.is_some(), "{whole}");
    }

    #[test]
    fn an_alarm_of_an_analog_value_is_left_out_with_the_reason() {
        let module = column();
        let part = AlarmMapping::of(&module, &arguments()).unwrap();
        assert_eq!(part.variables, []);
        let why = &part.left_out[0];
        assert!(
            why.contains("LevelHigh") && why.contains("above or below 95"),
            "{why}"
        );
        assert!(
            part.yaml(&module)
                .unwrap()
                .contains("# left out: LevelHigh")
        );
        let module = with_trigger(|value| matches!(value, PeaValue::Boolean(_)), "maybe");
        let part = AlarmMapping::of(&module, &arguments()).unwrap();
        assert_eq!(part.left_out.len(), 1, "{part:?}");
    }

    #[test]
    fn a_manifest_without_alarms_is_said_to_have_none() {
        let mut module = column();
        module.alarms.clear();
        let part = AlarmMapping::of(&module, &arguments()).unwrap();
        let text = part.yaml(&module).unwrap();
        assert!(text.ends_with("# The manifest has no alarms.\n"), "{text}");
    }
}
