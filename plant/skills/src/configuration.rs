//! The configuration of a component: limits, defaults, periods and product data that an admitted
//! client sets while the component runs.
//!
//! A configuration is checked as a whole, stored, and then applied as a whole. It acts on the next
//! run of each skill; a run in progress keeps its parameters.

mod change;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use async_trait::async_trait;
use serde_json::Value as Json;
use tokio::sync::watch;

use crate::driver::{Driver, RunResults, Work};
use crate::driver_error::{DriverError, InvalidParameter};
use crate::parameters::{Parameters, SkillParameter, shortened};
use crate::value::{SkillValue, ValueError};
use crate::values::ValueFacts;
use crate::yaml::{Place, YamlFinding, YamlFindingCode, nearest};

pub use self::change::FieldChange;

/// A field of the configuration.
#[derive(Debug, Clone, PartialEq)]
pub struct Configurable {
    /// The description.
    pub facts: Arc<ValueFacts>,
    /// The value without a configuration.
    pub default: Option<SkillValue>,
    /// The effect.
    pub effect: FieldEffect,
    /// The skills on which it acts; empty for all skills.
    pub skills: Vec<String>,
    /// The location in the document.
    pub place: Place,
}

/// The effect of a field.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum FieldEffect {
    /// The highest value of a parameter: higher values are lowered.
    Limits(String),
    /// The value of a parameter that is not given.
    Sets(String),
    /// The period of measurements in ms, of the named value or of all values.
    Period(Option<String>),
    /// Data for programs of the user.
    Data,
}

/// A configuration that is not accepted.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{field}: {reason}")]
pub struct NotConfigured {
    /// The first wrong field; empty if the fault is not that of a field.
    pub field: String,
    /// The reason.
    pub reason: FieldError,
}

/// The reason why a field, or a configuration, is not accepted.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum FieldError {
    /// The argument is not a list of names and values.
    #[error("the argument is not an array of KeyValuePair")]
    NoPairs,
    /// The component has no such field.
    #[error("there is no field {name}; the fields are {}", fields.join(", "))]
    Unknown {
        /// The start of the name.
        name: String,
        /// The fields of the component.
        fields: Vec<String>,
    },
    /// The field has two values.
    #[error("the field is given twice")]
    Twice,
    /// A skill cannot have values of the type.
    #[error("the value has a type that is not supported")]
    Unsupported,
    /// The value has another type than the field.
    #[error(transparent)]
    Value(#[from] ValueError),
    /// The value is NaN or infinite.
    #[error("{0} is not a number")]
    Unreal(SkillValue),
    /// The text is too long, or not a single line.
    #[error("expected a line of at most {LONGEST_TEXT} bytes")]
    NoLine(String),
    /// The array is too long.
    #[error("expected at most {MOST_ELEMENTS} elements")]
    Elements(usize),
    /// The number is out of the range of the field.
    #[error("expected {low} to {high}{}, found {found}", behind(unit.as_deref()))]
    OutOfRange {
        /// The lowest value.
        low: f64,
        /// The highest value.
        high: f64,
        /// The symbol of the unit.
        unit: Option<String>,
        /// The number.
        found: f64,
    },
    /// The file of the configured values cannot be used.
    #[error("cannot {operation} {}: {why}", path.display())]
    Store {
        /// The operation, as `write`.
        operation: &'static str,
        /// The file.
        path: PathBuf,
        /// The reason.
        why: String,
    },
}

/// Returns the symbol of a unit as it follows a number.
fn behind(unit: Option<&str>) -> String {
    unit.map_or_else(String::new, |unit| format!(" {unit}"))
}

/// The values of the fields.
type Values = BTreeMap<String, SkillValue>;

/// The configuration of a component. Clones share it.
#[derive(Debug, Clone)]
pub struct ComponentConfiguration {
    fields: Arc<Vec<Configurable>>,
    values: watch::Sender<Arc<Values>>,
    store: Option<Arc<PathBuf>>,
    /// Held while values are set, so that no change is lost.
    setting: Arc<Mutex<()>>,
}

impl Default for ComponentConfiguration {
    fn default() -> Self {
        Self::new(Vec::new(), None)
    }
}

impl ComponentConfiguration {
    /// Creates the configuration with the values in `store`, a file that is written at each change.
    /// Stored values that do not fit any more are ignored, with a warning.
    #[must_use]
    pub fn new(fields: Vec<Configurable>, store: Option<&Path>) -> Self {
        let configuration = Self {
            fields: Arc::new(fields),
            values: watch::Sender::new(Arc::default()),
            store: store.map(|path| Arc::new(path.to_owned())),
            setting: Arc::default(),
        };
        let stored = store.filter(|_| !configuration.fields.is_empty());
        match stored.map(read) {
            None | Some(Ok(None)) => {}
            Some(Ok(Some(stored))) => configuration.restore(&stored),
            Some(Err(why)) => tracing::warn!("ignored the stored configuration: {why}"),
        }
        configuration
    }

    /// Returns the fields.
    #[must_use]
    pub fn fields(&self) -> &[Configurable] {
        &self.fields
    }

    /// Returns the values of the configured fields, and their changes.
    #[must_use]
    pub fn watch(&self) -> watch::Receiver<Arc<Values>> {
        self.values.subscribe()
    }

    /// Returns the value of a field: as configured, or its default.
    #[must_use]
    pub fn value(&self, field: &Configurable) -> Option<SkillValue> {
        field.value_in(&self.values.borrow())
    }

    fn unknown(&self, name: &str) -> FieldError {
        FieldError::Unknown {
            name: shortened(name),
            fields: self.fields.iter().map(|of| of.facts.name.clone()).collect(),
        }
    }

    fn restore(&self, stored: &serde_json::Map<String, Json>) {
        let mut values = Values::new();
        for (name, json) in stored {
            let field = self.fields.iter().find(|field| field.facts.name == *name);
            let Some(field) = field else {
                tracing::warn!(
                    field = name,
                    "ignored a stored value: there is no such field"
                );
                continue;
            };
            let read = field.facts.shape.read_json(json).map_err(FieldError::from);
            match read.and_then(|value| field.take(value)) {
                Ok(value) => drop(values.insert(name.clone(), value)),
                Err(why) => tracing::warn!(field = name, "ignored a stored value: {why}"),
            }
        }
        self.values.send_replace(Arc::new(values));
    }

    /// Returns the fields that act on a skill, with their values at one time.
    fn of_skill(&self, skill: &str) -> Vec<(&Configurable, SkillValue)> {
        let values = Arc::clone(&self.values.borrow());
        let acting = self.fields.iter().filter(|field| field.acts_on(skill));
        acting
            .filter_map(|field| Some((field, field.value_in(&values)?)))
            .collect()
    }

    /// Returns the configured period of the measurements of values with these names.
    pub(crate) fn period(&self, names: &[String]) -> Option<Duration> {
        let values = Arc::clone(&self.values.borrow());
        let periods = self.fields.iter().filter_map(|field| {
            let FieldEffect::Period(of) = &field.effect else {
                return None;
            };
            let is_meant = of.as_ref().is_none_or(|name| names.contains(name));
            let ms = field.value_in(&values).filter(|_| is_meant)?.as_f64()?;
            Duration::try_from_secs_f64(ms / 1000.0).ok()
        });
        periods.min()
    }

    /// Returns the driver with the effects of the configuration on a skill.
    #[must_use]
    pub fn applied(&self, skill: &str, driver: Arc<dyn Driver>) -> Arc<dyn Driver> {
        if !self.fields.iter().any(|field| field.acts_on(skill)) {
            return driver;
        }
        Arc::new(Configured {
            skill: skill.to_owned(),
            configuration: self.clone(),
            driver,
        })
    }
}

impl Configurable {
    /// Returns a finding if no skill has the parameter of the field. Each skill has its name and
    /// its parameters.
    pub(crate) fn lacks_parameter(
        &self,
        skills: &[(&str, &[SkillParameter])],
    ) -> Option<YamlFinding> {
        let (FieldEffect::Limits(wanted) | FieldEffect::Sets(wanted)) = &self.effect else {
            return None;
        };
        let acting = skills.iter().filter(|(skill, _)| self.acts_on(skill));
        let parameters: Vec<&SkillParameter> = acting.flat_map(|(_, of)| of.iter()).collect();
        if parameters.iter().any(|parameter| parameter.name == *wanted) {
            return None;
        }
        let names: Vec<&str> = parameters.iter().map(|of| of.name.as_str()).collect();
        let message = format!("no skill has a parameter `{}`", shortened(wanted));
        let finding = YamlFinding::error(YamlFindingCode::WrongValue, self.place, message);
        Some(match nearest(wanted, names.iter().copied()) {
            Some(near) => finding.with_help(format!("did you mean `{near}`?")),
            None => finding,
        })
    }

    /// Returns the value of the field among configured values, or its default.
    fn value_in(&self, values: &Values) -> Option<SkillValue> {
        let configured = values.get(&self.facts.name).cloned();
        configured.or_else(|| self.default.clone())
    }

    fn acts_on(&self, skill: &str) -> bool {
        let acts = !matches!(self.effect, FieldEffect::Period(_));
        acts && (self.skills.is_empty() || self.skills.iter().any(|name| name == skill))
    }

    /// Converts a value to the type of the field and checks it.
    ///
    /// # Errors
    /// The reason why it does not fit.
    pub fn take(&self, value: SkillValue) -> Result<SkillValue, FieldError> {
        let ValueFacts {
            shape, range, unit, ..
        } = &*self.facts;
        let found = value.shape();
        let Some(value) = shape.take(value) else {
            let expected = *shape;
            return Err(ValueError::Shape { expected, found }.into());
        };
        if value.is_unreal() {
            return Err(FieldError::Unreal(value));
        }
        if let SkillValue::String(text) = &value
            && (text.len() > LONGEST_TEXT || text.contains(char::is_control))
        {
            return Err(FieldError::NoLine(text.clone()));
        }
        let elements = if let SkillValue::Array(_, elements) = &value {
            elements.as_slice()
        } else {
            std::slice::from_ref(&value)
        };
        if elements.len() > MOST_ELEMENTS {
            return Err(FieldError::Elements(elements.len()));
        }
        if let Some((low, high)) = *range
            && let Some(found) = elements
                .iter()
                .filter_map(SkillValue::as_f64)
                .find(|number| !(low..=high).contains(number))
        {
            let unit = unit.clone();
            return Err(FieldError::OutOfRange {
                low,
                high,
                unit,
                found,
            });
        }
        Ok(value)
    }
}

/// A driver with the effects of the configuration.
struct Configured {
    skill: String,
    configuration: ComponentConfiguration,
    driver: Arc<dyn Driver>,
}

#[async_trait]
impl Driver for Configured {
    fn can_suspend(&self) -> bool {
        self.driver.can_suspend()
    }

    fn halt_timeout(&self) -> Option<Duration> {
        self.driver.halt_timeout()
    }

    fn check(&self, parameters: &Parameters) -> Result<(), InvalidParameter> {
        self.driver.check(parameters)
    }

    fn uses(&self) -> Vec<String> {
        self.driver.uses()
    }

    /// Adds the configured parameters, and lowers those above their limits.
    fn prepared(
        &self,
        declared: &[SkillParameter],
        mut given: Vec<(String, SkillValue)>,
    ) -> Vec<(String, SkillValue)> {
        let acting = self.configuration.of_skill(&self.skill);
        for (field, value) in &acting {
            if let FieldEffect::Sets(parameter) = &field.effect
                && declared.iter().any(|known| known.name == *parameter)
                && !given.iter().any(|(name, _)| name == parameter)
            {
                given.push((parameter.clone(), value.clone()));
            }
        }
        for (field, limit) in &acting {
            let FieldEffect::Limits(parameter) = &field.effect else {
                continue;
            };
            let Some(known) = declared.iter().find(|known| known.name == *parameter) else {
                continue;
            };
            match given.iter_mut().find(|(name, _)| name == parameter) {
                Some((_, value)) => *value = lowered(value.clone(), limit),
                None => {
                    let default = known.default.clone();
                    given.extend(default.map(|value| (parameter.clone(), lowered(value, limit))));
                }
            }
        }
        given
    }

    async fn run(&self, work: Work) -> Result<RunResults, DriverError> {
        let configured: Vec<(String, SkillValue)> = self
            .configuration
            .of_skill(&self.skill)
            .into_iter()
            .map(|(field, value)| (field.facts.name.clone(), value))
            .collect();
        for (name, value) in &configured {
            work.note(format!("configured: {name} is {value}")).await;
        }
        self.driver.run(work.with_configuration(configured)).await
    }
}

/// Lowers a number, and each number of an array, to a limit. A limit that the type cannot hold
/// takes the place of the whole value, so that the Start is refused.
fn lowered(value: SkillValue, limit: &SkillValue) -> SkillValue {
    let Some(highest) = limit.as_f64() else {
        return value;
    };
    if let SkillValue::Array(builtin, elements) = value {
        let mut fits = true;
        let elements = elements.into_iter().map(|element| {
            let shape = element.shape();
            let element = lowered(element, limit);
            fits &= element.shape() == shape;
            element
        });
        let elements: Vec<SkillValue> = elements.collect();
        return match fits {
            true => SkillValue::Array(builtin, elements),
            false => limit.clone(),
        };
    }
    match value.as_f64() {
        Some(number) if number > highest => {
            let shape = value.shape();
            // A limit that is not a whole number is rounded down for a whole parameter.
            let whole = shape.read_json(&Json::from(highest));
            let floor = || {
                let json: Json = serde_json::from_str(&format!("{:.0}", highest.floor())).ok()?;
                shape.read_json(&json).ok()
            };
            whole.ok().or_else(floor).unwrap_or_else(|| limit.clone())
        }
        _ => value,
    }
}

fn read(path: &Path) -> Result<Option<serde_json::Map<String, Json>>, FieldError> {
    let cannot = |why: &dyn std::fmt::Display| FieldError::Store {
        operation: "read",
        path: path.to_owned(),
        why: why.to_string(),
    };
    let length = match std::fs::metadata(path) {
        Ok(about) => about.len(),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(cannot(&error)),
    };
    if length > LONGEST_FILE {
        return Err(cannot(&"the file is too long"));
    }
    let text = std::fs::read_to_string(path).map_err(|error| cannot(&error))?;
    match serde_json::from_str(&text) {
        Ok(Json::Object(values)) => Ok(Some(values)),
        Ok(_) => Err(cannot(&"it is not a JSON object")),
        Err(error) => Err(cannot(&error)),
    }
}

fn write(path: &Path, values: &Values) -> Result<(), FieldError> {
    let cannot = |why: &dyn std::fmt::Display| FieldError::Store {
        operation: "write",
        path: path.to_owned(),
        why: why.to_string(),
    };
    let json: serde_json::Map<String, Json> = values
        .iter()
        .map(|(name, value)| (name.clone(), value.to_json()))
        .collect();
    if let Some(folder) = path.parent() {
        std::fs::create_dir_all(folder).map_err(|error| cannot(&error))?;
    }
    let text = format!("{}\n", Json::Object(json));
    plant_opcua::synced::replace(path, text.as_bytes()).map_err(|error| cannot(&error))
}

const LONGEST_TEXT: usize = 4096;
const MOST_ELEMENTS: usize = 1024;
const LONGEST_FILE: u64 = 1 << 20;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::conformance;
    use crate::value::{Builtin, ValueShape};

    fn field(name: &str, effect: FieldEffect, range: Option<(f64, f64)>) -> Configurable {
        let builtin = match effect {
            FieldEffect::Data => Builtin::String,
            FieldEffect::Limits(_) | FieldEffect::Sets(_) | FieldEffect::Period(_) => {
                Builtin::Double
            }
        };
        Configurable {
            facts: Arc::new(ValueFacts {
                name: name.to_owned(),
                shape: ValueShape::scalar(builtin),
                unit: None,
                range,
                about: String::new(),
            }),
            default: None,
            effect,
            skills: Vec::new(),
            place: Place::START,
        }
    }

    fn fields() -> Vec<Configurable> {
        vec![
            field(
                "ForceLimit",
                FieldEffect::Limits("Force".to_owned()),
                Some((5.0, 50.0)),
            ),
            field("UsualForce", FieldEffect::Sets("Force".to_owned()), None),
            field("Product", FieldEffect::Data, None),
        ]
    }

    fn given(name: &str, value: impl Into<SkillValue>) -> Vec<(String, SkillValue)> {
        vec![(name.to_owned(), value.into())]
    }

    /// Succeeds, and records the force and the configuration of each run.
    #[derive(Default)]
    struct Recorder(Mutex<Vec<(f64, usize)>>);

    #[async_trait]
    impl Driver for Recorder {
        async fn run(&self, work: Work) -> Result<RunResults, DriverError> {
            let force = work.parameters().number("Force").unwrap();
            let configured = work.configuration().len();
            self.0.lock().unwrap().push((force, configured));
            Ok(given("Gripped", true))
        }
    }

    #[tokio::test]
    async fn a_configuration_acts_on_the_next_run() {
        let configuration = ComponentConfiguration::new(fields(), None);
        let recorder = Arc::new(Recorder::default());
        let driver = configuration.applied("GraspSkillType", recorder.clone());
        let run = async |force: Vec<(String, SkillValue)>| {
            let run = conformance::run_once("GraspSkillType", driver.clone(), force);
            let outcome = run.await.unwrap();
            assert!(outcome.succeeded, "{}", outcome.message);
            outcome.trace
        };
        run(given("Force", 80.0)).await;
        configuration.set(given("ForceLimit", 30.0)).unwrap();
        let trace = run(given("Force", 80.0)).await;
        let noted = |line: &String| line.ends_with("configured: ForceLimit is 30.0");
        assert!(trace.iter().any(noted), "{trace:?}");
        run(given("Force", 12.0)).await;
        configuration.set(given("UsualForce", 25.0)).unwrap();
        run(Vec::new()).await;
        configuration.set(given("UsualForce", 40.0)).unwrap();
        run(Vec::new()).await;
        let seen = recorder.0.lock().unwrap().clone();
        assert_eq!(
            seen,
            [(80.0, 0), (30.0, 1), (12.0, 1), (25.0, 2), (30.0, 2)]
        );
    }

    #[test]
    fn fields_that_are_set_at_the_same_time_are_all_kept() {
        let names: Vec<String> = (0..8).map(|number| format!("Field{number}")).collect();
        let fields = names
            .iter()
            .map(|name| field(name, FieldEffect::Data, None));
        let configuration = ComponentConfiguration::new(fields.collect(), None);
        std::thread::scope(|scope| {
            for name in &names {
                let configuration = configuration.clone();
                scope.spawn(move || configuration.set(given(name, "A")).unwrap());
            }
        });
        assert_eq!(configuration.watch().borrow().len(), names.len());
    }

    #[test]
    fn a_limit_that_the_type_cannot_hold_takes_the_place_of_the_value() {
        let below = SkillValue::from(-1.0);
        let bytes = |byte: u8| SkillValue::Array(Builtin::Byte, vec![SkillValue::Byte(byte)]);
        assert_eq!(
            lowered(SkillValue::Byte(9), &4.5.into()),
            SkillValue::Byte(4)
        );
        assert_eq!(lowered(bytes(9), &4.5.into()), bytes(4));
        assert_eq!(lowered(SkillValue::Byte(9), &below), below);
        assert_eq!(lowered(bytes(9), &below), below);
        assert_eq!(ValueShape::scalar(Builtin::Byte).take(below.clone()), None);
        assert_eq!(ValueShape::array(Builtin::Byte).take(below), None);
    }

    #[test]
    fn a_wrong_field_is_refused_with_its_reason_and_nothing_is_set() {
        let configuration = ComponentConfiguration::new(fields(), None);
        let refused = |values: Vec<(String, SkillValue)>| {
            let refused = configuration.set(values).unwrap_err();
            (refused.field, refused.reason.to_string())
        };
        let both = [given("Product", "A"), given("ForceLimit", 60.0)].concat();
        let reason = "expected 5 to 50, found 60".to_owned();
        assert_eq!(refused(both), ("ForceLimit".to_owned(), reason));
        assert!(configuration.watch().borrow().is_empty());
        assert!(
            refused(given("Speed", 1.0))
                .1
                .contains("ForceLimit, UsualForce, Product")
        );
        assert!(
            refused(given("Product", 1.0))
                .1
                .contains("expected String, found Double")
        );
        assert!(
            refused(given("ForceLimit", f64::NAN))
                .1
                .contains("is not a number")
        );
        assert!(refused(given("Product", "a\nb")).1.contains("a line"));
        let twice = [given("Product", "A"), given("Product", "B")].concat();
        assert!(refused(twice).1.contains("twice"));
    }

    #[test]
    fn a_configuration_is_there_again_after_a_restart_and_unfit_values_are_left_out() {
        let folder = std::env::temp_dir().join(format!("configuration-{}", std::process::id()));
        let path = folder.join("configuration.json");
        let configuration = ComponentConfiguration::new(fields(), Some(&path));
        let both = [given("Product", "A"), given("ForceLimit", 20.0)].concat();
        configuration.set(both).unwrap();
        let again = ComponentConfiguration::new(fields(), Some(&path));
        assert_eq!(*again.watch().borrow(), *configuration.watch().borrow());
        let mut narrower = fields();
        narrower.truncate(1);
        narrower[0] = field(
            "ForceLimit",
            FieldEffect::Limits("Force".to_owned()),
            Some((0.0, 10.0)),
        );
        let narrow = ComponentConfiguration::new(narrower, Some(&path));
        assert!(narrow.watch().borrow().is_empty());
        std::fs::write(&path, "[").unwrap();
        assert!(
            ComponentConfiguration::new(fields(), Some(&path))
                .watch()
                .borrow()
                .is_empty()
        );
        std::fs::remove_file(&path).unwrap();
        std::fs::create_dir(&path).unwrap();
        let refused = configuration.set(given("Product", "B")).unwrap_err();
        assert!(refused.to_string().contains("cannot write"), "{refused}");
        let product = configuration.watch().borrow().get("Product").cloned();
        assert_eq!(
            product,
            Some("A".into()),
            "what cannot be stored is not applied"
        );
        std::fs::remove_dir_all(folder).unwrap();
    }
}
