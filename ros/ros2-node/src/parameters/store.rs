//! The parameters of a node and the responses of their six services. The module is pure: bytes in,
//! bytes out.

use std::collections::BTreeSet;

use bytes::Bytes;

use super::ParameterValue;
use crate::cdr::{CdrReader, CdrWriter, Malformed};

/// A declared parameter.
#[derive(Debug, Clone, PartialEq)]
pub struct DeclaredParameter {
    /// The name: parts joined by dots.
    pub name: String,
    /// The value; its type never changes.
    pub value: ParameterValue,
    /// The description for operators.
    pub description: String,
    /// Whether clients cannot set the parameter.
    pub read_only: bool,
}

/// The declared parameters, ordered by name.
#[derive(Debug, Clone, Default)]
pub(super) struct ParameterStore(Vec<DeclaredParameter>);

/// One of the six services.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ParameterService {
    Describe,
    Types,
    Get,
    List,
    Set,
    SetAtomically,
}

impl ParameterService {
    pub(super) const ALL: [Self; 6] = [
        Self::Describe,
        Self::Types,
        Self::Get,
        Self::List,
        Self::Set,
        Self::SetAtomically,
    ];

    /// Returns the service's name below the node's name, and its type in `rcl_interfaces`.
    pub(super) const fn names(self) -> (&'static str, &'static str) {
        match self {
            Self::Describe => ("describe_parameters", "DescribeParameters"),
            Self::Types => ("get_parameter_types", "GetParameterTypes"),
            Self::Get => ("get_parameters", "GetParameters"),
            Self::List => ("list_parameters", "ListParameters"),
            Self::Set => ("set_parameters", "SetParameters"),
            Self::SetAtomically => ("set_parameters_atomically", "SetParametersAtomically"),
        }
    }
}

impl ParameterStore {
    pub(super) fn new(mut parameters: Vec<DeclaredParameter>) -> Self {
        parameters.sort_by(|a, b| a.name.cmp(&b.name));
        Self(parameters)
    }

    pub(super) fn get(&self, name: &str) -> Option<&DeclaredParameter> {
        self.0.iter().find(|parameter| parameter.name == name)
    }

    /// Returns the response to a request, and the parameters that the request changed.
    pub(super) fn answer(
        &mut self,
        question: ParameterService,
        request: &[u8],
    ) -> Result<(Bytes, Vec<DeclaredParameter>), Malformed> {
        let mut reader = CdrReader::new(request)?;
        let mut writer = CdrWriter::new();
        let mut changed = Vec::new();
        match question {
            ParameterService::Describe => {
                let found = self.declared(&reader.sequence(CdrReader::string)?);
                writer.sequence(&found, |writer, found| describe(writer, found));
            }
            ParameterService::Types => {
                let found = self.declared(&reader.sequence(CdrReader::string)?);
                writer.sequence(&found, |writer, found| writer.u8(found.value.kind()));
            }
            ParameterService::Get => {
                let found = self.declared(&reader.sequence(CdrReader::string)?);
                writer.sequence(&found, |writer, found| found.value.write(writer));
            }
            ParameterService::List => {
                let prefixes = reader.sequence(CdrReader::string)?;
                let depth = reader.u64()?;
                self.list(&mut writer, &prefixes, depth);
            }
            ParameterService::Set => {
                let wanted = reader.sequence(assignment)?;
                writer.sequence(&wanted, |writer, one| {
                    let result = self.set(std::slice::from_ref(one));
                    write_result(writer, &result);
                    changed.extend(result.unwrap_or_default());
                });
            }
            ParameterService::SetAtomically => {
                let wanted = reader.sequence(assignment)?;
                let result = self.set(&wanted);
                write_result(&mut writer, &result);
                changed = result.unwrap_or_default();
            }
        }
        Ok((writer.finish(), changed))
    }

    /// Returns the parameters with these names. As in rclcpp and rclpy, the result is empty if any
    /// name is not declared; tools show this as "not set".
    fn declared(&self, names: &[String]) -> Vec<&DeclaredParameter> {
        let found: Option<Vec<&DeclaredParameter>> =
            names.iter().map(|name| self.get(name)).collect();
        found.unwrap_or_default()
    }

    /// Lists names as rclcpp does: the names at or below one of the prefixes, at most `depth` parts
    /// below it; 0 means any number.
    fn list(&self, writer: &mut CdrWriter, prefixes: &[String], depth: u64) {
        let near = |rest: &str| {
            let parts = rest.split('.').count();
            depth == 0 || u64::try_from(parts).is_ok_and(|parts| parts <= depth)
        };
        let below = |name: &str, prefix: &str| {
            let rest = name
                .strip_prefix(prefix)
                .and_then(|rest| rest.strip_prefix('.'));
            name == prefix || rest.is_some_and(near)
        };
        let all = self.0.iter().map(|parameter| parameter.name.as_str());
        let names: Vec<&str> = all
            .filter(|name| match prefixes {
                [] => near(name),
                prefixes => prefixes.iter().any(|prefix| below(name, prefix)),
            })
            .collect();
        let parents = names.iter().filter_map(|name| name.rsplit_once('.'));
        let parents: BTreeSet<&str> = parents.map(|(parent, _)| parent).collect();
        let parents: Vec<&str> = parents.into_iter().collect();
        writer.sequence(&names, |writer, name| writer.string(name));
        writer.sequence(&parents, |writer, name| writer.string(name));
    }

    /// Sets all parameters or none; returns the changed parameters.
    fn set(
        &mut self,
        wanted: &[(String, ParameterValue)],
    ) -> Result<Vec<DeclaredParameter>, SetParameterError> {
        for (name, value) in wanted {
            let Some(found) = self.get(name) else {
                return Err(SetParameterError::Undeclared(name.clone()));
            };
            if found.read_only {
                return Err(SetParameterError::ReadOnly(name.clone()));
            }
            if found.value.kind() != value.kind() {
                return Err(SetParameterError::OtherType(name.clone()));
            }
        }
        let mut changed = Vec::new();
        for (name, value) in wanted {
            let found = self.0.iter_mut().find(|parameter| parameter.name == *name);
            if let Some(found) = found
                && found.value != *value
            {
                found.value = value.clone();
                changed.push(found.clone());
            }
        }
        Ok(changed)
    }
}

/// The reason why the parameter with this name is not set. The client gets its text.
#[derive(Debug, thiserror::Error)]
enum SetParameterError {
    /// The node has no such parameter.
    #[error("parameter '{0}' cannot be set because it was not declared")]
    Undeclared(String),
    /// The node sets the parameter itself.
    #[error("parameter '{0}' cannot be set because it is read-only")]
    ReadOnly(String),
    /// The value has another type.
    #[error("parameter '{0}' cannot have a value of another type")]
    OtherType(String),
}

/// Decodes a `rcl_interfaces/msg/Parameter`.
fn assignment(reader: &mut CdrReader<'_>) -> Result<(String, ParameterValue), Malformed> {
    Ok((reader.string()?, ParameterValue::read(reader)?))
}

/// Encodes a `rcl_interfaces/msg/ParameterDescriptor`.
fn describe(writer: &mut CdrWriter, parameter: &DeclaredParameter) {
    writer.string(&parameter.name);
    writer.u8(parameter.value.kind());
    writer.string(&parameter.description);
    writer.string("");
    writer.bool(parameter.read_only);
    writer.bool(false);
    // No range, neither for floating-point numbers nor for integers.
    writer.u32(0);
    writer.u32(0);
}

/// Encodes a `rcl_interfaces/msg/SetParametersResult`.
fn write_result(
    writer: &mut CdrWriter,
    result: &Result<Vec<DeclaredParameter>, SetParameterError>,
) {
    let reason = result.as_ref().err().map(ToString::to_string);
    writer.bool(result.is_ok());
    writer.string(reason.as_deref().unwrap_or_default());
}

/// Encodes a `rcl_interfaces/msg/ParameterEvent` about changed parameters.
pub(super) fn event(node: &str, unix_nanos: i128, changed: &[DeclaredParameter]) -> Bytes {
    let (seconds, nanos) = (
        unix_nanos.div_euclid(1_000_000_000),
        unix_nanos.rem_euclid(1_000_000_000),
    );
    let mut writer = CdrWriter::new();
    writer.i32(i32::try_from(seconds).unwrap_or(i32::MAX));
    writer.u32(u32::try_from(nanos).unwrap_or_default());
    writer.string(node);
    // New parameters.
    writer.u32(0);
    writer.sequence(changed, |writer, parameter| {
        writer.string(&parameter.name);
        parameter.value.write(writer);
    });
    // Deleted parameters.
    writer.u32(0);
    writer.finish()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parameter(name: &str, value: ParameterValue, read_only: bool) -> DeclaredParameter {
        DeclaredParameter {
            name: name.to_owned(),
            value,
            description: String::new(),
            read_only,
        }
    }

    fn store() -> ParameterStore {
        ParameterStore::new(vec![
            parameter("use_sim_time", ParameterValue::Bool(false), false),
            parameter("arm.speed", ParameterValue::Double(1.0), false),
            parameter("arm.joint.limit", ParameterValue::Integer(3), true),
        ])
    }

    fn listed(prefixes: &[&str], depth: u64) -> Vec<String> {
        let mut writer = CdrWriter::new();
        writer.sequence(prefixes, |writer, name| writer.string(name));
        writer.i64(i64::try_from(depth).unwrap());
        let (answer, _) = store()
            .answer(ParameterService::List, &writer.finish())
            .unwrap();
        CdrReader::new(&answer)
            .unwrap()
            .sequence(CdrReader::string)
            .unwrap()
    }

    #[test]
    fn names_are_listed_by_prefix_and_depth_as_rclcpp_does() {
        let all = ["arm.joint.limit", "arm.speed", "use_sim_time"];
        assert_eq!(listed(&[], 0), all);
        assert_eq!(listed(&[], 1), ["use_sim_time"]);
        assert_eq!(listed(&["arm"], 1), ["arm.speed"]);
        assert_eq!(listed(&["arm", "use_sim_time"], 0), all);
        assert_eq!(listed(&["ar"], 0), [""; 0]);
    }

    /// Returns the number of elements in the response to a request for these names.
    fn counted(question: ParameterService, names: &[&str]) -> u32 {
        let mut writer = CdrWriter::new();
        writer.sequence(names, |writer, name| writer.string(name));
        let (answer, _) = store().answer(question, &writer.finish()).unwrap();
        u32::from_le_bytes(answer[4..8].try_into().unwrap())
    }

    #[test]
    fn of_names_that_are_not_all_declared_nothing_is_told_as_by_rclpy() {
        for question in [
            ParameterService::Describe,
            ParameterService::Types,
            ParameterService::Get,
        ] {
            assert_eq!(counted(question, &["use_sim_time", "arm.speed"]), 2);
            assert_eq!(counted(question, &["arm.speed", "no_such_parameter"]), 0);
            assert_eq!(counted(question, &["no_such_parameter"]), 0);
        }
    }

    #[test]
    fn of_several_set_together_all_are_or_none() {
        let mut store = store();
        let set = |name: &str, value| (name.to_owned(), value);
        let refused = store.set(&[
            set("use_sim_time", ParameterValue::Bool(true)),
            set("arm.joint.limit", ParameterValue::Integer(4)),
        ]);
        assert!(refused.unwrap_err().to_string().contains("read-only"));
        assert_eq!(
            store.get("use_sim_time").unwrap().value,
            ParameterValue::Bool(false)
        );
        for (name, value, why) in [
            ("nothing", ParameterValue::Bool(true), "not declared"),
            ("arm.speed", ParameterValue::Integer(1), "another type"),
        ] {
            let refused = store.set(&[set(name, value)]);
            assert!(refused.unwrap_err().to_string().contains(why));
        }
        let changed = store.set(&[
            set("use_sim_time", ParameterValue::Bool(true)),
            set("arm.speed", ParameterValue::Double(1.0)),
        ]);
        // The other parameter has the value already.
        assert_eq!(changed.unwrap().len(), 1);
    }

    #[test]
    fn a_request_that_ends_early_is_refused() {
        for question in ParameterService::ALL {
            for bytes in [&[0, 1, 0][..], &[0, 1, 0, 0, 9, 0, 0, 0]] {
                assert_eq!(store().answer(question, bytes).unwrap_err(), Malformed);
            }
        }
    }
}
