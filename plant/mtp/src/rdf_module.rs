//! Statements about the servers, nodes, data assemblies, outputs and state machines of a module.

use crate::escaped;
use crate::model::{
    ControlRole, DataAssembly, Family, Module, ModuleAlarm, ModuleOutput, MtpService, OutputRole,
    VariableLink,
};
use crate::rdf::{ModuleStatements, Object};
use crate::state::{Command, State};
use crate::vocabulary as v;

impl ModuleStatements<'_> {
    /// Adds everything except the services.
    pub(crate) fn whole(&mut self, iri: &str, module: &Module) {
        for server in &module.servers {
            let server_iri = self.name(iri, "server", &server.id, &server.name);
            self.link(iri, v::HAS_SERVER, &server_iri);
            self.is_a(&server_iri, &[v::SERVER, v::PAPER_SERVER]);
            self.text(&server_iri, v::RDFS_LABEL, &server.name);
            self.text(&server_iri, v::ENDPOINT, &server.endpoint);
            self.text(&server_iri, v::PAPER_ENDPOINT, &server.endpoint);
            let nodes = format!("{server_iri}/nodes");
            self.link(&server_iri, v::PAPER_HAS_NODE_SET, &nodes);
            self.is_a(&nodes, &[v::PAPER_NODE_SET]);
            for item in &module.items {
                if item.node.endpoint == server.endpoint {
                    let item = item_iri(iri, &item.node.item, &item.name);
                    self.link(&nodes, v::PAPER_CONTAINS_NODE, &item);
                }
            }
        }
        for item in &module.items {
            let item_iri = item_iri(iri, &item.node.item, &item.name);
            self.link(iri, v::HAS_NODE, &item_iri);
            self.is_a(&item_iri, &[v::NODE, v::OPC_UA_ITEM, v::PAPER_VARIABLE]);
            self.text(&item_iri, v::RDFS_LABEL, &item.name);
            self.node(&item_iri, &item.node);
        }
        for assembly in &module.assemblies {
            self.assembly(iri, assembly);
        }
        for output in &module.process_values {
            let about = format!("{}.{}", module.name, output.name);
            let output_iri = self.name(iri, "process-value", &output.id, &output.name);
            self.output(&output_iri, &about, output);
            self.link(iri, v::HAS_PROCESS_VALUE, &output_iri);
        }
        for alarm in &module.alarms {
            self.alarm(iri, alarm);
        }
        for picture in &module.pictures {
            self.picture(iri, picture);
        }
    }

    fn assembly(&mut self, module: &str, assembly: &DataAssembly) {
        let iri = self.element_iri(&assembly.id);
        self.link(module, v::HAS_ELEMENT, &iri);
        self.is_a(&iri, &[v::ELEMENT]);
        let classes: &[&str] = match assembly.family {
            Family::Sensor => &[v::SENSOR, v::PAPER_SENSOR],
            Family::Actuator => &[v::ACTUATOR, v::PAPER_ACTUATOR],
            Family::Parameter
            | Family::Input
            | Family::Service
            | Family::Diagnostic
            | Family::Information
            | Family::Other => &[],
        };
        self.is_a(&iri, classes);
        if !classes.is_empty() {
            self.link(module, v::PAPER_CONSISTS_OF, &iri);
            self.link(&iri, v::PAPER_IS_PART_OF, module);
        }
        self.text(&iri, v::RDFS_LABEL, &assembly.name);
        self.text(&iri, v::ELEMENT_KIND, &assembly.kind);
        for variable in &assembly.variables {
            match &variable.link {
                VariableLink::Node(node) => {
                    let item = item_iri(module, &node.item, "");
                    self.link(&iri, v::HAS_NODE, &item);
                    self.text(&item, v::ROLE, &variable.name);
                }
                VariableLink::Constant(text) => {
                    let constant = format!("{iri}/constant/{}", escaped(&variable.name));
                    self.link(&iri, v::HAS_PARAMETER, &constant);
                    self.text(&constant, v::ROLE, &variable.name);
                    self.text(&constant, v::VALUE, text);
                }
            }
        }
        if assembly.family == Family::Sensor
            && let Some(kind) = assembly.value_kind()
            && let Some(node) = assembly.node(&["V"])
        {
            let output = format!("{iri}/output");
            self.link(module, v::HAS_PROCESS_VALUE, &output);
            self.is_a(&output, &[v::OUTPUT_PARAMETER, v::PAPER_SKILL_OUTPUT]);
            let label = format!("{}.V", assembly.name);
            self.text(&output, v::RDFS_LABEL, &label);
            self.text(&output, v::HAS_VARIABLE_NAME, &assembly.name);
            self.text(&output, v::HAS_VARIABLE_TYPE, kind.data_type());
            self.text(&output, v::PARAMETER_KIND, "sensor");
            self.node(&output, node);
            let [min, max, unit] =
                ["VSclMin", "VSclMax", "VUnit"].map(|name| assembly.bound(&[name]));
            self.scale(&output, &label, [&min, &max, &unit]);
        }
    }

    /// Adds the outputs of a service or a procedure, and the process values that it reads. Returns
    /// the relation of each to the skills.
    pub(crate) fn outputs(
        &mut self,
        of: &str,
        about: &str,
        outputs: &[ModuleOutput],
    ) -> Vec<(&'static str, String)> {
        let mut iris = Vec::new();
        for output in outputs {
            let iri = self.name(of, "output", &output.id, &output.name);
            self.output(&iri, &format!("{about}.{}", output.name), output);
            let [own, paper] = match output.role {
                OutputRole::ProcessValueIn => [v::HAS_INPUT_PARAMETER, v::PAPER_HAS_PARAMETER],
                OutputRole::Report | OutputRole::ProcessValueOut => {
                    [v::HAS_OUTPUT_PARAMETER, v::PAPER_HAS_OUTPUT]
                }
            };
            iris.push((own, iri.clone()));
            iris.push((paper, iri));
        }
        iris
    }

    fn output(&mut self, iri: &str, about: &str, output: &ModuleOutput) {
        let (class, kind) = match output.role {
            OutputRole::Report => (v::OUTPUT_PARAMETER, "report"),
            OutputRole::ProcessValueOut => (v::OUTPUT_PARAMETER, "process value"),
            OutputRole::ProcessValueIn => (v::INPUT_PARAMETER, "process value from another module"),
        };
        self.is_a(iri, &[class, v::PAPER_SKILL_OUTPUT]);
        if output.role != OutputRole::Report {
            self.is_a(iri, &[v::PROCESS_VALUE]);
        }
        self.text(iri, v::RDFS_LABEL, about);
        self.text(iri, v::HAS_VARIABLE_NAME, &output.name);
        self.text(iri, v::HAS_VARIABLE_TYPE, output.kind.data_type());
        self.text(iri, v::PARAMETER_KIND, kind);
        if let Some(node) = &output.node {
            self.node(iri, node);
        }
        self.scale(iri, about, [&output.min, &output.max, &output.unit]);
    }

    fn alarm(&mut self, module: &str, alarm: &ModuleAlarm) {
        let iri = self.name(module, "alarm", &alarm.id, &alarm.name);
        self.link(module, v::HAS_ALARM, &iri);
        self.is_a(&iri, &[v::ALARM]);
        self.text(&iri, v::RDFS_LABEL, &alarm.name);
        if !alarm.text.is_empty() {
            self.text(&iri, v::RDFS_COMMENT, &alarm.text);
        }
        if let Some(severity) = alarm.severity {
            self.say(&iri, v::SEVERITY, Object::Integer(severity.into()));
        }
        if let Some(node) = &alarm.trigger {
            self.node(&iri, node);
            self.text(&iri, v::TRIGGER_VALUE, &alarm.trigger_value);
        }
    }

    /// Adds the state machine of a service, with the values of its states and commands. Returns its
    /// IRI.
    pub(crate) fn state_machine(
        &mut self,
        service_iri: &str,
        service: &MtpService,
        commands: &[(Command, String)],
    ) -> String {
        let machine = format!("{service_iri}/machine");
        self.is_a(&machine, &[v::STATE_MACHINE, v::PAPER_STATE_MACHINE]);
        for state in State::ALL {
            let iri = state_iri(service_iri, *state);
            self.link(&machine, v::CONSISTS_OF_STATE, &iri);
            self.is_a(&iri, &[v::STATE]);
            self.text(&iri, v::RDFS_LABEL, state.name());
            self.say(&iri, v::STATE_VALUE, Object::Integer(state.bit().into()));
            let mut followers: Vec<(String, State, Option<&str>)> = Vec::new();
            for (command, command_iri) in commands {
                if let Some(next) = state.after(*command) {
                    followers.push((command.to_string(), next, Some(command_iri)));
                }
            }
            let is_self_completing = service
                .procedures
                .iter()
                .any(|procedure| procedure.is_self_completing);
            let next = if *state == State::Execute && is_self_completing {
                Some(State::Completing)
            } else {
                state.next()
            };
            followers.extend(next.map(|next| ("Done".to_owned(), next, None)));
            for (name, next, command) in followers {
                let transition = format!("{machine}/transition/{state}.{name}");
                self.link(&machine, v::CONSISTS_OF_TRANSITION, &transition);
                self.is_a(&transition, &[v::TRANSITION]);
                self.text(&transition, v::RDFS_LABEL, &format!("{state}.{name}"));
                self.link(&transition, v::HAS_SOURCE_STATE, &iri);
                let target = state_iri(service_iri, next);
                self.link(&transition, v::HAS_TARGET_STATE, &target);
                if let Some(command) = command {
                    self.link(&transition, v::IS_INVOKED_BY, command);
                }
            }
        }
        machine
    }

    /// Adds the variables of a service that select and report procedures and report the state.
    /// Returns the relation of each to the skills of the service.
    pub(crate) fn service_variables(
        &mut self,
        service_iri: &str,
        service: &MtpService,
    ) -> Vec<(&'static str, String)> {
        let all = [
            (
                ControlRole::ProcedureWanted,
                "ProcedureExt",
                [v::INPUT_PARAMETER, v::PAPER_SKILL_PARAMETER],
                [v::HAS_INPUT_PARAMETER, v::PAPER_HAS_PARAMETER],
            ),
            (
                ControlRole::ProcedureCurrent,
                "ProcedureCur",
                [v::OUTPUT_PARAMETER, v::PAPER_SKILL_OUTPUT],
                [v::HAS_OUTPUT_PARAMETER, v::PAPER_HAS_OUTPUT],
            ),
            (
                ControlRole::ProcedureRequested,
                "ProcedureReq",
                [v::OUTPUT_PARAMETER, v::PAPER_SKILL_OUTPUT],
                [v::HAS_OUTPUT_PARAMETER, v::PAPER_HAS_OUTPUT],
            ),
            (
                ControlRole::State,
                "StateCur",
                [v::CURRENT_STATE_OUTPUT, v::PAPER_CURRENT_STATE_OUTPUT],
                [v::HAS_CURRENT_STATE_OUTPUT, v::PAPER_HAS_OUTPUT],
            ),
        ];
        let mut relations = Vec::new();
        for (role, name, classes, predicates) in all {
            let Some(node) = service.control.node(role) else {
                continue;
            };
            let iri = format!("{service_iri}/variable/{name}");
            self.is_a(&iri, &[v::SERVICE_VARIABLE]);
            self.is_a(&iri, &classes);
            self.text(&iri, v::RDFS_LABEL, &format!("{}.{name}", service.name));
            self.text(&iri, v::HAS_VARIABLE_NAME, name);
            self.text(&iri, v::HAS_VARIABLE_TYPE, "UInt32");
            self.text(&iri, v::PARAMETER_KIND, "service");
            self.say(&iri, v::IS_REQUIRED, Object::Boolean(false));
            self.node(&iri, node);
            let of = predicates.map(|predicate| (predicate, iri.clone()));
            relations.extend(of);
        }
        relations
    }
}

/// Returns the IRI of a state of a service.
#[must_use]
pub fn state_iri(service: &str, state: State) -> String {
    format!("{service}/machine/state/{state}")
}

/// Returns the IRI of an OPCUAItem.
fn item_iri(module: &str, id: &str, name: &str) -> String {
    format!(
        "{module}/item/{}",
        escaped(if id.is_empty() { name } else { id })
    )
}
