//! The components of a product configuration, as discovery found them.

use async_trait::async_trait;
use mtp::ConfiguredComponent;
use skills::{ConfigurationHandle, FieldChange, SetFieldsFault, SkillClient};

use super::PlantState;
use crate::product_configuration::{ConfigurationTarget, ProductComponent, fields};

/// A component without configurable fields.
struct NotConfigurable;

#[async_trait]
impl ConfigurationTarget for NotConfigurable {
    async fn set(&self, _: &FieldChange, _: bool) -> Result<FieldChange, SetFieldsFault> {
        Err(SetFieldsFault::None)
    }
}

/// A connected component.
struct ConnectedTarget {
    handle: ConfigurationHandle,
    /// The units of the fields in the file.
    units: Vec<(String, String)>,
    /// Keeps the connection.
    _client: SkillClient,
}

#[async_trait]
impl ConfigurationTarget for ConnectedTarget {
    async fn set(
        &self,
        fields: &FieldChange,
        checks_only: bool,
    ) -> Result<FieldChange, SetFieldsFault> {
        if checks_only {
            self.handle.check_units(&self.units).await?;
        }
        self.handle.set_fields(fields, checks_only).await
    }
}

impl PlantState {
    /// Connects to a component of a product configuration.
    pub(crate) async fn configured(&self, of: &ConfiguredComponent) -> ProductComponent {
        let target = self.target(of).await;
        ProductComponent {
            application_uri: of.application_uri.clone(),
            fields: fields(of),
            target,
        }
    }

    async fn target(
        &self,
        of: &ConfiguredComponent,
    ) -> Result<Box<dyn ConfigurationTarget>, String> {
        let known = {
            let present = self.present();
            let mut all = present.components.values();
            let component = all.find(|one| one.application_uri == of.application_uri);
            component.map(|one| (one.endpoint.clone(), one.configuration.clone()))
        };
        let (endpoint, configuration) = known.ok_or(NOT_FOUND)?;
        let Some(configuration) = configuration else {
            return Ok(Box::new(NotConfigurable));
        };
        let client = SkillClient::connect(&endpoint, &self.client).await;
        let client = client.map_err(|fault| format!("{endpoint}: {fault}"))?;
        Ok(Box::new(ConnectedTarget {
            handle: client.configuration(&configuration),
            units: of.units.clone(),
            _client: client,
        }))
    }
}

/// The reason why a component is not reached.
const NOT_FOUND: &str = "it is not in the plant: no component with skills or \
     configurable fields has this ApplicationUri";

#[cfg(test)]
mod tests {
    use std::path::Path;
    use std::sync::Arc;

    use knowledge::Knowledge;
    use mtp::ConfiguredValue;
    use plant_opcua::supervision::{Registrar, Supervision};
    use skills::{ClientOptions, Component, SkillFault, SkillValue};

    use skills::server::{ComponentServer, ServeSettings};

    use super::super::{QueriedComponent, SeenServer};
    use super::*;
    use crate::product_configuration::{FieldsOutcome, ProductOutcome, configure};
    use crate::sources::MesSources;

    const GRIPPER: &str = "urn:test:gripper";
    const SENSOR: &str = "urn:test:sensor";

    /// Serves a gripper with a field, or without its skill.
    fn serve(name: &str, has_skill: bool, field: &str) -> ComponentServer {
        let text = format!(
            "component: {name}\napplication_uri: urn:test:{name}\nnamespace: 7\n\
             endpoint: opc.tcp://127.0.0.1:0\nsecurity: [None]\nconfigurable: [{field}]\n\
             skills: [{{name: Grasp, type: GraspSkillType, driver: simulated}}]\n"
        );
        let component = Component::from_yaml(&text, Path::new(""));
        let mut component =
            component.unwrap_or_else(|findings| panic!("{}", findings.render("x", &text)));
        if !has_skill {
            component.skills.clear();
        }
        // The client of the test configures the component as its supervisor.
        let supervision = Supervision::default();
        supervision.registered_with(Registrar {
            application_uri: ClientOptions::default().application_uri,
            proven: false,
        });
        let settings = ServeSettings {
            supervision,
            ..ServeSettings::default()
        };
        let server = ComponentServer::build(&component, &settings, |_, _| Vec::new()).unwrap();
        server.start();
        server
    }

    fn gripper() -> ComponentServer {
        let field = "{name: GripForce, sets: Force, unit: N, range: [5, 50]}";
        serve("gripper", true, field)
    }

    fn sensor() -> ComponentServer {
        let field = "{name: Pause, unit: ms, range: [50, 5000]}";
        serve("sensor", false, field)
    }

    fn plant() -> PlantState {
        let knowledge = Arc::new(Knowledge::new().unwrap());
        let sources = Arc::new(MesSources::new(Arc::clone(&knowledge)));
        let client = ClientOptions {
            within: std::time::Duration::from_secs(10),
            ..ClientOptions::default()
        };
        PlantState::new(knowledge, sources, client, Vec::new())
    }

    /// Queries a server as after its discovery.
    async fn seen(cell: &PlantState, server: &ComponentServer) {
        let client = SkillClient::connect(server.url(), cell.client()).await;
        let client = client.unwrap();
        let found = client.skills_and_configurations().await.unwrap();
        let seen = SeenServer {
            name: server.url().to_owned(),
            url: server.url().to_owned(),
            at_ms: 1,
        };
        for (uri, found) in QueriedComponent::all(&client.application_uri(), found) {
            cell.came(&seen, &uri, found, 2);
        }
        client.close().await;
    }

    async fn product(cell: &PlantState, force: f64, pause: f64) -> Vec<ProductComponent> {
        let mut product = Vec::new();
        for (uri, field, unit, value) in [
            (SENSOR, "Pause", "ms", pause),
            (GRIPPER, "GripForce", "N", force),
        ] {
            let of = ConfiguredComponent {
                application_uri: uri.to_owned(),
                name: field.to_owned(),
                line: 1,
                fields: vec![(field.to_owned(), ConfiguredValue::Number(value))],
                units: vec![(field.to_owned(), unit.to_owned())],
            };
            product.push(cell.configured(&of).await);
        }
        product
    }

    /// Returns the configured value of a component; a check returns the value before.
    async fn value(component: &ProductComponent) -> Option<SkillValue> {
        let target = component.target.as_ref().map_err(String::as_str).unwrap();
        let mut before = target.set(&component.fields, true).await.unwrap();
        before.pop().unwrap().1
    }

    /// Accepts its fields, and is lost when they are set.
    struct LostWhenSet;

    #[async_trait]
    impl ConfigurationTarget for LostWhenSet {
        async fn set(
            &self,
            fields: &FieldChange,
            checks_only: bool,
        ) -> Result<FieldChange, SetFieldsFault> {
            match checks_only {
                true => Ok(fields.clone()),
                false => Err(SkillFault::Lost("no response".to_owned()).into()),
            }
        }
    }

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn a_component_without_skills_is_configured_with_the_others_or_set_back() {
        let cell = plant();
        let (gripper, sensor) = (gripper(), sensor());
        seen(&cell, &gripper).await;
        let without = configure(&product(&cell, 20.0, 100.0).await, false).await;
        assert_eq!(without.outcome, ProductOutcome::Refused);
        let [of_sensor, of_gripper] = &without.components[..] else {
            panic!("{without:?}");
        };
        assert_eq!(of_sensor.outcome, FieldsOutcome::NotReached);
        let reason = of_sensor.reason.as_ref().unwrap();
        assert!(reason.starts_with("it is not in the plant"), "{reason}");
        assert_eq!(of_gripper.outcome, FieldsOutcome::Accepted, "{without:?}");

        seen(&cell, &sensor).await;
        let status = cell.status();
        let names = status["components"].as_array().unwrap().iter();
        let names: Vec<_> = names.map(|one| (&one["name"], &one["skills"])).collect();
        let listed = serde_json::json!([["gripper", ["Grasp"]], ["sensor", []]]);
        assert_eq!(serde_json::json!(names), listed);

        // All components are checked first: a wrong field of the gripper leaves the sensor alone.
        let refused = configure(&product(&cell, 70.0, 100.0).await, false).await;
        assert_eq!(refused.outcome, ProductOutcome::Refused);
        assert_eq!(value(&product(&cell, 20.0, 100.0).await[0]).await, None);
        let set = configure(&product(&cell, 20.0, 100.0).await, false).await;
        assert_eq!(set.outcome, ProductOutcome::Configured, "{set:?}");
        let mut next = product(&cell, 30.0, 200.0).await;
        assert_eq!(value(&next[0]).await, Some(100.0.into()));
        assert_eq!(value(&next[1]).await, Some(20.0.into()));

        next[1].target = Ok(Box::new(LostWhenSet));
        let back = configure(&next, false).await;
        assert_eq!(back.outcome, ProductOutcome::Unknown);
        assert_eq!(back.components[0].outcome, FieldsOutcome::SetBack);
        assert_eq!(back.components[1].outcome, FieldsOutcome::Unknown);
        assert_eq!(value(&next[0]).await, Some(100.0.into()));

        cell.went(sensor.url(), "it was lost");
        let gone = configure(&product(&cell, 20.0, 100.0).await, false).await;
        assert_eq!(gone.components[0].outcome, FieldsOutcome::NotReached);
        gripper.stop().await;
        sensor.stop().await;
    }

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn a_component_with_skills_and_without_fields_refuses() {
        let cell = plant();
        let gripper = serve("gripper", true, "");
        seen(&cell, &gripper).await;
        let refused = configure(&product(&cell, 20.0, 100.0).await, false).await;
        let of_gripper = &refused.components[1];
        assert_eq!(of_gripper.outcome, FieldsOutcome::Refused);
        let reason = of_gripper.reason.as_ref().unwrap();
        assert!(reason.contains("no configurable fields"), "{reason}");
        gripper.stop().await;
    }
}
