//! Parameters and results of skills.

use std::fmt;
use std::str::FromStr;

use crate::refusal::{RefusalCode, SkillRefusal};
use crate::value::{SkillValue, ValueShape};

/// The URI of the types' namespace.
pub const NAMESPACE: &str = "urn:ua-bridge:skills";

/// A type, identified by the URI of its namespace and its BrowseName.
///
/// Its text is `nsu=<uri>;<BrowseName>`; a name without a URI is a type of
/// [`NAMESPACE`](crate::NAMESPACE).
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct ParameterType {
    /// The URI of the namespace.
    pub namespace: String,
    /// The BrowseName.
    pub name: String,
}

impl ParameterType {
    /// Returns the name of a type of [`NAMESPACE`](crate::NAMESPACE).
    #[must_use]
    pub fn own(name: &str) -> Self {
        Self {
            namespace: NAMESPACE.to_owned(),
            name: name.to_owned(),
        }
    }
}

impl fmt::Display for ParameterType {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "nsu={};{}", self.namespace, self.name)
    }
}

/// A text that is not the name of a type.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("expected a type as GraspSkillType or nsu=<namespace uri>;<BrowseName>, found `{0}`")]
pub struct NoTypeName(pub String);

impl FromStr for ParameterType {
    type Err = NoTypeName;

    fn from_str(text: &str) -> Result<Self, NoTypeName> {
        let (namespace, name) = match text.strip_prefix("nsu=") {
            Some(rest) => rest
                .rsplit_once(';')
                .ok_or_else(|| NoTypeName(text.to_owned()))?,
            None => (NAMESPACE, text),
        };
        let fits = |part: &str| {
            !part.is_empty() && part.len() <= LONGEST_NAME && !part.chars().any(char::is_control)
        };
        if !fits(namespace) || !fits(name) || (namespace == NAMESPACE && name.contains(';')) {
            return Err(NoTypeName(text.chars().take(LONGEST_NAME).collect()));
        }
        Ok(Self {
            namespace: namespace.to_owned(),
            name: name.to_owned(),
        })
    }
}

const LONGEST_NAME: usize = 512;

/// A parameter or result of a skill type.
#[derive(Debug, Clone, PartialEq)]
pub struct SkillParameter {
    /// The BrowseName.
    pub name: String,
    /// Type and rank.
    pub shape: ValueShape,
    /// The number of elements of an array, if the type defines it.
    pub length: Option<u32>,
    /// The default value. A parameter without a default is mandatory.
    pub default: Option<SkillValue>,
    /// The symbol of the unit, as `m/s`.
    pub unit: Option<String>,
    /// The lowest and the highest value of a number.
    pub range: Option<(f64, f64)>,
    /// Description for people.
    pub about: String,
}

impl SkillParameter {
    /// Converts a value to the type of the parameter and checks it.
    ///
    /// # Errors
    /// - BadTypeMismatch for a value of another type
    /// - BadInvalidArgument for a number that is NaN, infinite or out of range, or an array of
    ///   another length
    pub fn take(&self, value: SkillValue) -> Result<SkillValue, SkillRefusal> {
        let Self { name, shape, .. } = self;
        let given = value.shape();
        let Some(value) = shape.take(value) else {
            return Err(SkillRefusal::new(
                RefusalCode::TypeMismatch,
                format!("{name} is {shape}, and {given} was given"),
            ));
        };
        let wrong = |why: String| {
            Err(SkillRefusal::new(
                RefusalCode::InvalidArgument,
                format!("{name} {why}"),
            ))
        };
        if value.is_unreal() {
            return wrong(format!("has a value that is no number: {value}"));
        }
        if let SkillValue::Array(_, elements) = &value
            && let Some(length) = self.length
            && u32::try_from(elements.len()) != Ok(length)
        {
            return wrong(format!(
                "has {length} values, and {} were given",
                elements.len()
            ));
        }
        if let (Some((low, high)), Some(number)) = (self.range, value.as_f64())
            && !(low..=high).contains(&number)
        {
            return wrong(format!("is from {low} to {high}, and {number} was given"));
        }
        Ok(value)
    }
}

/// The parameters of one run, complete and checked, in the order of the type.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Parameters(Vec<(String, SkillValue)>);

impl Parameters {
    /// Completes the given parameters with the defaults of the type.
    ///
    /// # Errors
    /// - BadArgumentsMissing with the names of the missing mandatory parameters
    /// - BadInvalidArgument for a name that the type does not have or that is given twice
    /// - As [`SkillParameter::take`]
    pub fn complete(
        declared: &[SkillParameter],
        given: Vec<(String, SkillValue)>,
    ) -> Result<Self, SkillRefusal> {
        let mut values: Vec<Option<SkillValue>> = vec![None; declared.len()];
        for (name, value) in given {
            let found = declared
                .iter()
                .zip(&mut values)
                .find(|(parameter, _)| parameter.name == name);
            let Some((parameter, place)) = found else {
                let text = format!("there is no parameter {}", shortened(&name));
                return Err(SkillRefusal::new(RefusalCode::InvalidArgument, text));
            };
            let value = parameter.take(value)?;
            if place.replace(value).is_some() {
                return Err(SkillRefusal::new(
                    RefusalCode::InvalidArgument,
                    format!("{name} is given twice"),
                ));
            }
        }
        let complete: Vec<(&SkillParameter, Option<SkillValue>)> = declared
            .iter()
            .zip(values)
            .map(|(parameter, value)| (parameter, value.or_else(|| parameter.default.clone())))
            .collect();
        let missing: Vec<&str> = complete
            .iter()
            .filter(|(_, value)| value.is_none())
            .map(|(parameter, _)| parameter.name.as_str())
            .collect();
        if !missing.is_empty() {
            let text = format!("{} must be given", missing.join(", "));
            return Err(SkillRefusal::new(RefusalCode::ArgumentsMissing, text));
        }
        let named = |(parameter, value): (&SkillParameter, Option<SkillValue>)| {
            Some((parameter.name.clone(), value?))
        };
        Ok(Self(complete.into_iter().filter_map(named).collect()))
    }

    /// Creates parameters from the values of another server, which has checked them.
    pub(crate) const fn shown(of: Vec<(String, SkillValue)>) -> Self {
        Self(of)
    }

    /// Returns the value of a parameter.
    #[must_use]
    pub fn get(&self, name: &str) -> Option<&SkillValue> {
        self.0
            .iter()
            .find(|(known, _)| known == name)
            .map(|(_, value)| value)
    }

    /// Returns the value of a numeric parameter.
    #[must_use]
    pub fn number(&self, name: &str) -> Option<f64> {
        self.get(name)?.as_f64()
    }

    /// Returns the elements of an array of numbers.
    #[must_use]
    pub fn numbers(&self, name: &str) -> Option<Vec<f64>> {
        self.get(name)?.as_f64s()
    }

    /// Returns the elements of an array of six numbers, for example a pose.
    #[must_use]
    pub fn six(&self, name: &str) -> Option<[f64; 6]> {
        self.numbers(name)?.try_into().ok()
    }

    /// Returns the value of a text parameter.
    #[must_use]
    pub fn text(&self, name: &str) -> Option<&str> {
        self.get(name)?.as_str()
    }

    /// Returns all names and values, in the order of the type.
    #[must_use]
    pub fn all(&self) -> &[(String, SkillValue)] {
        &self.0
    }
}

/// Returns at most 64 characters of an external name, with control characters replaced.
pub(crate) fn shortened(name: &str) -> String {
    name.chars()
        .take(64)
        .map(|c| if c.is_control() { '\u{fffd}' } else { c })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn move_parameters() -> Vec<SkillParameter> {
        crate::model::find("PtpMoveSkillType").unwrap().parameters()
    }

    fn refusal(given: Vec<(&str, SkillValue)>) -> (RefusalCode, String) {
        let given = given
            .into_iter()
            .map(|(name, value)| (name.to_owned(), value));
        let refusal = Parameters::complete(&move_parameters(), given.collect()).unwrap_err();
        (refusal.code, refusal.text)
    }

    #[test]
    fn what_is_not_given_has_its_default_or_is_missing_by_name() {
        let target = ("TargetPosition".to_owned(), SkillValue::from([0.1; 6]));
        let parameters = Parameters::complete(&move_parameters(), vec![target]).unwrap();
        assert_eq!(parameters.number("MaxVelocity"), Some(0.2));
        assert_eq!(parameters.six("TargetPosition"), Some([0.1; 6]));
        assert_eq!(parameters.text("ToolFrame"), Some("flange"));
        assert_eq!(
            refusal(vec![]),
            (
                RefusalCode::ArgumentsMissing,
                "TargetPosition must be given".to_owned()
            )
        );
    }

    #[test]
    fn a_wrong_parameter_is_refused_by_name_and_with_what_is_right() {
        let target = || ("TargetPosition", SkillValue::from([0.1; 6]));
        let cases = [
            (
                vec![("TargetPosition", SkillValue::from(vec![0.1; 5]))],
                RefusalCode::InvalidArgument,
                "TargetPosition has 6 values, and 5 were given",
            ),
            (
                vec![("TargetPosition", SkillValue::from(0.1))],
                RefusalCode::TypeMismatch,
                "TargetPosition is Double[], and Double was given",
            ),
            (
                vec![("TargetPosition", SkillValue::from([f64::NAN; 6]))],
                RefusalCode::InvalidArgument,
                "TargetPosition has a value that is no number: [\"NaN\",\"NaN\",\"NaN\",\"NaN\",\"NaN\",\"NaN\"]",
            ),
            (
                vec![target(), ("MaxVelocity", SkillValue::from(-1.0))],
                RefusalCode::InvalidArgument,
                "MaxVelocity is from 0.001 to 10, and -1 was given",
            ),
            (
                vec![target(), ("Speed", SkillValue::from(1.0))],
                RefusalCode::InvalidArgument,
                "there is no parameter Speed",
            ),
            (
                vec![target(), target()],
                RefusalCode::InvalidArgument,
                "TargetPosition is given twice",
            ),
        ];
        for (given, code, text) in cases {
            assert_eq!(refusal(given), (code, text.to_owned()));
        }
    }

    #[test]
    fn a_type_is_named_with_or_without_its_namespace() {
        let own: ParameterType = "GraspSkillType".parse().unwrap();
        assert_eq!(own.to_string(), "nsu=urn:ua-bridge:skills;GraspSkillType");
        let vendor: ParameterType = "nsu=urn:vendor;v2;VacuumGraspSkillType".parse().unwrap();
        assert_eq!(
            (vendor.namespace.as_str(), vendor.name.as_str()),
            ("urn:vendor;v2", "VacuumGraspSkillType")
        );
        assert_eq!(vendor.to_string().parse(), Ok(vendor));
        for wrong in ["", "nsu=urn:vendor", "nsu=;x", "nsu=urn:vendor;", "a;b"] {
            assert!(wrong.parse::<ParameterType>().is_err(), "{wrong}");
        }
    }
}
