//! The values of a component, for clients: variables below the folder `Values`.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use plant_opcua::server::{IdRange, InstanceError, ObjectSpec, OpcUaServer, VariableSpec};
use plant_opcua::types::{
    DataTypeId, DataValue, EUInformation, ExtensionObject, LocalizedText, NodeId, ObjectTypeId,
    QualifiedName, Range, ReferenceTypeId, StatusCode, VariableTypeId, Variant,
};
use tokio::task::JoinSet;

use super::show::date_time;
use crate::component::{Component, DeviceSensor, ValueSource};
use crate::configuration::ComponentConfiguration;
use crate::model::TableUnit;
use crate::shown::SkillObserver;
use crate::values::{
    LiveValue, Measured, NewestState, Tally, UnknownValue, ValueFacts, ValueSensor, watch,
};
use crate::variant::to_variant;
use crate::yaml::{YamlFinding, YamlFindingCode};

/// The statistics of skills that computed values need, by the names of the skills; `None` for all
/// skills.
pub(super) struct Tallies(BTreeMap<Option<String>, Tally>);

impl Tallies {
    pub(super) fn of(component: &Component) -> Self {
        let wanted = component.values.iter().filter_map(|value| {
            let ValueSource::Computed(_, skill) = &value.source else {
                return None;
            };
            Some(skill.clone())
        });
        let tally = |skill: Option<String>| {
            let tally = Tally::new(skill.as_deref().unwrap_or("all skills"));
            (skill, tally)
        };
        Self(wanted.map(tally).collect())
    }

    /// Returns the observers of a skill.
    pub(super) fn observers(&self, number: u16, name: &str) -> Vec<Box<dyn SkillObserver>> {
        let of = |skill: &Option<String>| skill.as_deref().is_none_or(|skill| skill == name);
        let counting = self.0.iter().filter(|(skill, _)| of(skill));
        counting.map(|(_, tally)| tally.observer(number)).collect()
    }
}

/// A source with the values that it measures.
struct Group {
    sensor: Arc<dyn ValueSensor>,
    period: Duration,
    measured: Measured,
}

/// The values of a component, by their numbers from 1, and their sources.
pub(super) struct ComponentValues {
    pub(super) live: Vec<LiveValue>,
    groups: Vec<Group>,
}

/// Groups the values of a component by their sources.
///
/// # Errors
/// A source that this program does not support.
pub(super) fn made(
    component: &Component,
    tallies: &Tallies,
) -> Result<ComponentValues, YamlFinding> {
    let mut made = ComponentValues {
        live: Vec::new(),
        groups: Vec::new(),
    };
    let mut devices: Option<Arc<dyn ValueSensor>> = None;
    let mut computed: BTreeMap<Option<String>, Arc<dyn ValueSensor>> = BTreeMap::new();
    for value in &component.values {
        let unsupported = |what: &str| {
            let message =
                format!("this program does not support `{what}` as the source of a value");
            Err(YamlFinding::error(
                YamlFindingCode::Source,
                value.place,
                message,
            ))
        };
        let (sensor, key) = match &value.source {
            ValueSource::Device(name) => {
                let Some(device) = &component.device else {
                    return unsupported("device");
                };
                let sensor = devices.get_or_insert_with(|| Arc::new(DeviceSensor(device.clone())));
                (Arc::clone(sensor), name.as_str())
            }
            ValueSource::Computed(measure, skill) => {
                let Some(tally) = tallies.0.get(skill) else {
                    return unsupported(measure.key());
                };
                let sensor = computed
                    .entry(skill.clone())
                    .or_insert_with(|| Arc::new(tally.clone()));
                (Arc::clone(sensor), measure.key())
            }
            ValueSource::Sensor(sensor) => (Arc::clone(sensor), value.facts.name.as_str()),
            ValueSource::Topic(_) => return unsupported("topic"),
            ValueSource::Exec(_) => return unsupported("exec"),
        };
        let mut groups = made.groups.iter_mut();
        let known = groups.find(|group| Arc::ptr_eq(&group.sensor, &sensor));
        let live = match known {
            Some(group) => {
                group.period = group.period.min(value.period);
                group.measured.add(key, &value.facts)
            }
            None => {
                let mut measured = Measured::default();
                let live = measured.add(key, &value.facts);
                made.groups.push(Group {
                    sensor,
                    period: value.period,
                    measured,
                });
                live
            }
        };
        made.live.push(live);
    }
    Ok(made)
}

/// Creates the nodes of the values, and starts the measurements.
pub(super) fn serve(
    server: &OpcUaServer,
    component: &NodeId,
    ids: &mut IdRange,
    (made, configuration): (ComponentValues, &ComponentConfiguration),
    tasks: &mut JoinSet<()>,
) -> Result<Vec<LiveValue>, InstanceError> {
    let ComponentValues { live, groups } = made;
    if live.is_empty() {
        return Ok(live);
    }
    let own = component.namespace;
    let folder = ObjectSpec {
        node_id: ids.next(),
        browse_name: QualifiedName::new(own, FOLDER),
        display_name: FOLDER.into(),
        type_definition: ObjectTypeId::FolderType.into(),
        parent: component.clone(),
        reference: ReferenceTypeId::HasComponent.into(),
        event_notifier: false,
    };
    server.add_object(&folder)?;
    for (number, value) in (1..).zip(&live) {
        let node = NodeId::new(own, FIRST_VALUE + number);
        let reason = add(server, (&folder.node_id, &node), value.facts(), ids)?;
        tasks.spawn(show(server.clone(), node, reason, value.clone()));
    }
    for group in groups {
        let Group {
            sensor,
            period,
            measured,
        } = group;
        let names = measured.names();
        let (periods, receiver) = tokio::sync::watch::channel(period);
        tasks.spawn(follow(configuration.clone(), (names, period), periods));
        tasks.spawn(watch(sensor, receiver, measured));
    }
    Ok(live)
}

/// Passes each configured period of the measurements on.
async fn follow(
    configuration: ComponentConfiguration,
    (names, usual): (Vec<String>, Duration),
    periods: tokio::sync::watch::Sender<Duration>,
) {
    let mut changes = configuration.watch();
    loop {
        changes.mark_unchanged();
        let period = configuration.period(&names).unwrap_or(usual);
        periods.send_if_modified(|known| {
            let is_new = *known != period;
            *known = period;
            is_new
        });
        // The configuration outlives the tasks of its component.
        if changes.changed().await.is_err() {
            return;
        }
    }
}

/// Adds a variable with its properties. Returns the property with the reason of a Bad status.
fn add(
    server: &OpcUaServer,
    (folder, node): (&NodeId, &NodeId),
    facts: &ValueFacts,
    ids: &mut IdRange,
) -> Result<NodeId, InstanceError> {
    let of_type = variable_type(facts);
    server.add_variable(&VariableSpec {
        node_id: node.clone(),
        browse_name: QualifiedName::new(node.namespace, facts.name.as_str()),
        display_name: LocalizedText::new("", &facts.name),
        type_definition: of_type.into(),
        parent: folder.clone(),
        reference: ReferenceTypeId::HasComponent.into(),
        data_type: NodeId::new(0, u32::from(facts.shape.builtin.id())),
        value_rank: if facts.shape.array { 1 } else { -1 },
        value: DataValue::new_now_status(Variant::Empty, StatusCode::BadWaitingForInitialData),
        writable: false,
    })?;
    describe(server, node, facts, ids)?;
    let name = QualifiedName::new(node.namespace, REASON);
    let property = (
        name,
        DataTypeId::String,
        Variant::from(UnknownValue::NotMeasured.to_string()),
    );
    add_property(server, node, ids, property)
}

/// Returns the type of a variable: AnalogItemType with a range (OPC 10000-8, 5.3.2.3).
pub(super) fn variable_type(facts: &ValueFacts) -> VariableTypeId {
    match (facts.range, &facts.unit) {
        (Some(_), _) => VariableTypeId::AnalogItemType,
        (None, Some(_)) => VariableTypeId::AnalogUnitType,
        (None, None) => VariableTypeId::BaseDataVariableType,
    }
}

/// Adds the properties with the unit, the range and the description of a variable.
pub(super) fn describe(
    server: &OpcUaServer,
    node: &NodeId,
    facts: &ValueFacts,
    ids: &mut IdRange,
) -> Result<(), InstanceError> {
    if let Some((low, high)) = facts.range {
        let range = ExtensionObject::from_message(Range { low, high });
        let name = QualifiedName::new(0, "EURange");
        add_property(server, node, ids, (name, DataTypeId::Range, range.into()))?;
    }
    if let Some(unit) = &facts.unit {
        let unit = ExtensionObject::from_message(engineering_unit(unit));
        let name = QualifiedName::new(0, "EngineeringUnits");
        let property = (name, DataTypeId::EUInformation, unit.into());
        add_property(server, node, ids, property)?;
    }
    if !facts.about.is_empty() {
        let name = QualifiedName::new(node.namespace, "About");
        let property = (
            name,
            DataTypeId::String,
            Variant::from(facts.about.as_str()),
        );
        add_property(server, node, ids, property)?;
    }
    Ok(())
}

fn add_property(
    server: &OpcUaServer,
    node: &NodeId,
    ids: &mut IdRange,
    (name, data_type, value): (QualifiedName, DataTypeId, Variant),
) -> Result<NodeId, InstanceError> {
    let node_id = ids.next();
    let display_name = LocalizedText::new("", name.name.as_ref());
    server.add_variable(&VariableSpec {
        node_id: node_id.clone(),
        browse_name: name,
        display_name,
        type_definition: VariableTypeId::PropertyType.into(),
        parent: node.clone(),
        reference: ReferenceTypeId::HasProperty.into(),
        data_type: data_type.into(),
        value_rank: -1,
        value: DataValue::new_now(value),
        writable: false,
    })?;
    Ok(node_id)
}

/// Returns the description of a unit. A unit without a UNECE code has the UnitId -1 (OPC 10000-8,
/// 5.6.3).
pub(super) fn engineering_unit(symbol: &str) -> EUInformation {
    let known = TableUnit::find(symbol);
    let id = known.and_then(|unit| i32::try_from(unit.id).ok());
    let namespace = known.map_or("", |_| UNECE);
    EUInformation {
        namespace_uri: namespace.into(),
        unit_id: id.unwrap_or(-1),
        display_name: LocalizedText::new("en", symbol),
        description: LocalizedText::new("en", known.map_or(symbol, |unit| unit.name)),
    }
}

/// Shows each change of a value.
async fn show(server: OpcUaServer, node: NodeId, reason: NodeId, value: LiveValue) {
    let mut readings = value.watch();
    loop {
        let reading = readings.borrow_and_update().clone();
        let status = status(value.facts(), &reading);
        let (variant, why) = match &reading.value {
            Ok(value) => (to_variant(value), String::new()),
            Err(why) => (Variant::Empty, why.to_string()),
        };
        let shown = DataValue {
            value: Some(variant),
            status: Some(status),
            source_timestamp: Some(date_time(reading.at)),
            ..DataValue::null()
        };
        let values = vec![
            (node.clone(), shown),
            (reason.clone(), DataValue::new_now(Variant::from(why))),
        ];
        if let Err(status) = server.show_all(values) {
            tracing::warn!(value = value.facts().name, %status, "cannot show a value");
        }
        if readings.changed().await.is_err() {
            return;
        }
    }
}

/// Returns the status of a reading.
#[must_use]
pub fn status(facts: &ValueFacts, reading: &NewestState) -> StatusCode {
    match &reading.value {
        Ok(value) => match (facts.range, value.as_f64()) {
            (Some((low, high)), Some(number)) if !(low..=high).contains(&number) => {
                StatusCode::UncertainEngineeringUnitsExceeded
            }
            _ => StatusCode::Good,
        },
        Err(UnknownValue::NotMeasured) => StatusCode::BadWaitingForInitialData,
        Err(_) => StatusCode::BadNoCommunication,
    }
}

/// The URI of units with UNECE codes (OPC 10000-8, 5.6.4.3).
const UNECE: &str = "http://www.opcfoundation.org/UA/units/un/cefact";
const FOLDER: &str = "Values";
/// The property with the reason of a Bad status.
const REASON: &str = "Reason";
/// The numeric identifier of value n is larger by n.
const FIRST_VALUE: u32 = 10;

#[cfg(test)]
mod tests {
    use std::path::Path;
    use std::time::SystemTime;

    use async_trait::async_trait;

    use super::*;
    use crate::component::{Device, DriverFault};
    use crate::driver::Driver;
    use crate::parameters::ParameterType;
    use crate::server::{ComponentServer, ServeSettings};
    use crate::value::{Builtin, SkillValue, ValueShape};
    use crate::values::DeviceValue;
    use crate::{DeviceKinds, PeerAccess};

    /// A device that is lost after its second measurement.
    #[derive(Debug)]
    struct Scale;

    #[async_trait]
    impl Device for Scale {
        fn driver(
            &self,
            _types: &[ParameterType],
            _peers: &PeerAccess,
        ) -> Result<Arc<dyn Driver>, DriverFault> {
            Err(DriverFault("a scale has no skills".to_owned()))
        }

        fn values(&self) -> &'static [DeviceValue] {
            const VALUES: [DeviceValue; 1] = [DeviceValue {
                name: "Weight",
                shape: ValueShape::scalar(Builtin::Double),
                unit: Some("kg"),
                range: Some((0.0, 5.0)),
                about: "The weight on the scale.",
            }];
            &VALUES
        }

        async fn measure(&self, period: Duration, out: &Measured) -> String {
            for weight in [1.5, 7.0] {
                out.put("Weight", Ok(weight.into()));
                tokio::time::sleep(period).await;
            }
            "the scale does not answer".to_owned()
        }
    }

    struct Scales;

    impl DeviceKinds for Scales {
        fn read(
            &self,
            _node: &crate::yaml::DocumentNode,
            _folder: &Path,
            _reader: &mut crate::yaml::YamlReader<'_>,
        ) -> Option<Arc<dyn Device>> {
            Some(Arc::new(Scale))
        }
    }

    #[tokio::test]
    async fn a_value_has_unit_and_range_and_is_bad_with_the_reason_while_the_device_is_lost() {
        let yaml = "component: scale\napplication_uri: urn:scale\nnamespace: 4\ndevice: scale\nvalues:\n  - {device: all, period: 100 ms}\n";
        let component = Component::from_yaml_with(yaml, Path::new(""), &Scales)
            .unwrap_or_else(|found| panic!("{}", found.render("x", yaml)));
        let served =
            ComponentServer::build(&component, &ServeSettings::default(), |_, _| Vec::new())
                .unwrap();
        let [value] = served.values() else {
            panic!("{:?}", served.values())
        };
        let mut readings = value.watch();
        let mut seen = Vec::new();
        while seen.len() < 3 {
            let reading = readings.borrow_and_update().clone();
            if reading.value != Err(UnknownValue::NotMeasured) {
                seen.push((status(value.facts(), &reading), reading.value));
            }
            readings.changed().await.unwrap();
        }
        let lost = UnknownValue::Reported("the scale does not answer".to_owned());
        let expected = [
            (StatusCode::Good, Ok(SkillValue::Double(1.5))),
            (
                StatusCode::UncertainEngineeringUnitsExceeded,
                Ok(SkillValue::Double(7.0)),
            ),
            (StatusCode::BadNoCommunication, Err(lost)),
        ];
        assert_eq!(seen, expected);
        let node = NodeId::new(1, 11);
        let server = &served.server;
        assert_eq!(server.browse_name(&node).unwrap().name.as_ref(), "Weight");
        let mut names: Vec<String> = server
            .children(&node)
            .iter()
            .map(|child| child.browse_name.name.as_ref().to_owned())
            .collect();
        names.sort();
        assert_eq!(names, ["About", "EURange", "EngineeringUnits", "Reason"]);
        served.stop().await;
    }

    #[test]
    fn a_unit_without_a_code_keeps_its_symbol() {
        assert_eq!(engineering_unit("mbar").unit_id, 0x4D_42_52);
        let unknown = engineering_unit("furlong");
        assert_eq!((unknown.unit_id, unknown.namespace_uri.as_ref()), (-1, ""));
        assert_eq!(unknown.display_name.text.as_ref(), "furlong");
    }

    #[test]
    fn the_first_reading_waits_for_its_value() {
        let facts = ValueFacts {
            name: "A".to_owned(),
            shape: ValueShape::scalar(Builtin::Double),
            unit: None,
            range: None,
            about: String::new(),
        };
        let reading = NewestState {
            value: Err(UnknownValue::NotMeasured),
            at: SystemTime::UNIX_EPOCH,
        };
        assert_eq!(
            status(&facts, &reading),
            StatusCode::BadWaitingForInitialData
        );
    }
}
