//! Data assemblies, process values and alarms.

use std::collections::BTreeMap;

use crate::caex::CaexElement;
use crate::model::{
    AssemblyVariable, DataAssembly, Family, ModuleAlarm, ModuleOutput, OpcUaNode, OutputRole,
    VariableLink,
};
use crate::read::{ElementIndex, is_assembly, is_list, is_true};

/// Returns the family of a data assembly by the whole path of its type.
fn family(path: &str) -> Family {
    let parts = || path.split('/');
    let is = |names: &[&str]| parts().any(|part| names.contains(&part));
    match () {
        () if is(&["IndicatorElement"]) => Family::Sensor,
        () if is(&["ActiveElement"]) => Family::Actuator,
        () if is(&["InputElement"]) => Family::Input,
        () if is(&[
            "DiagnosticElement",
            "HealthStateView",
            "ProcedureHealthView",
        ]) =>
        {
            Family::Diagnostic
        }
        () if is(&["PeaElement", "PeaInformationLabel"]) => Family::Information,
        () if is(&["ServiceControl"]) => Family::Service,
        () if is(SENSORS) => Family::Sensor,
        () if is(ACTUATORS) => Family::Actuator,
        () if is(&["OperationElement", "ParameterElement"]) => Family::Parameter,
        () if parts().any(|part| part.ends_with("Param") || part.ends_with("Op")) => {
            Family::Parameter
        }
        () if parts().any(|part| part.ends_with("ProcessValueIn")) => Family::Input,
        () => Family::Other,
    }
}

impl<'a> ElementIndex<'a> {
    /// Reads all data assemblies below an element.
    pub(crate) fn data_assemblies(&mut self, root: &'a CaexElement) -> Vec<DataAssembly> {
        let mut found = Vec::new();
        let mut waiting = vec![(root, false)];
        while let Some((element, is_in_list)) = waiting.pop() {
            if is_assembly(element, is_in_list) {
                found.push(self.data_assembly(element));
                continue;
            }
            let is_list = is_list(element);
            for child in element.children.iter().rev() {
                waiting.push((child, is_list));
            }
        }
        found
    }

    fn data_assembly(&mut self, element: &'a CaexElement) -> DataAssembly {
        let mut variables = Vec::new();
        for attribute in &element.attributes {
            let value = attribute.value.trim();
            if value.is_empty() || attribute.name == "RefID" {
                continue;
            }
            let link = match self.node_of(value) {
                Some(node) => VariableLink::Node(node),
                None if attribute.is_link => {
                    let about = format!("{}.{}", element.name, attribute.name);
                    self.find(element, &about, "it refers to an ID that no OPCUAItem has");
                    continue;
                }
                None => VariableLink::Constant(value.to_owned()),
            };
            variables.push(AssemblyVariable {
                name: attribute.name.clone(),
                link,
            });
        }
        DataAssembly {
            id: element.id.clone(),
            name: element.name.clone(),
            kind: element.kind().to_owned(),
            family: family(&element.path),
            variables,
        }
    }

    /// Reads the output values below a service or a procedure, or the values of a module.
    pub(crate) fn outputs(&mut self, about: &str, of: &'a CaexElement) -> Vec<ModuleOutput> {
        let mut outputs = Vec::new();
        for child in &of.children {
            let Some(role) = role_of(child) else { continue };
            match self.output(child, role) {
                Some(output) => outputs.push(output),
                None => {
                    let about = format!("{about}/{}", child.name);
                    self.find(
                        child,
                        &about,
                        "no data assembly with a value belongs to this output",
                    );
                }
            }
        }
        outputs
    }

    fn output(&mut self, element: &'a CaexElement, role: OutputRole) -> Option<ModuleOutput> {
        let assembly = self.data_assembly(self.value_assembly(element)?);
        Some(ModuleOutput {
            id: element.id.clone(),
            name: element.name.clone(),
            role,
            kind: assembly.value_kind()?,
            min: assembly.bound(&["VSclMin", "VMin"]),
            max: assembly.bound(&["VSclMax", "VMax"]),
            unit: assembly.bound(&["VUnit"]),
            node: assembly.node(&["V", "VExt", "VOut", "VFbk"]).cloned(),
            assembly: assembly.id,
        })
    }

    /// Reads the IDs of the equipment that a service or a procedure requires.
    pub(crate) fn equipment(&mut self, about: &str, of: &'a CaexElement) -> Vec<String> {
        let mut ids = Vec::new();
        for child in &of.children {
            if child.kind() != "RequiredEquipment" {
                continue;
            }
            match self.value_assembly(child) {
                Some(assembly) => ids.push(assembly.id.clone()),
                None => {
                    let about = format!("{about}/{}", child.name);
                    self.find(child, &about, "no data assembly belongs to this equipment");
                }
            }
        }
        ids
    }

    /// Reads the alarms of a module.
    pub(crate) fn alarms(&mut self, root: &'a CaexElement) -> Vec<ModuleAlarm> {
        let texts: BTreeMap<&str, &str> = root
            .all()
            .filter(|one| matches!(one.kind(), "AlarmMessage" | "AlarmText"))
            .map(|one| {
                let text = one.value(&["Text", "AlarmText", "Message", "Value"]);
                (&*one.id, text.unwrap_or(&one.name))
            })
            .collect();
        let mut alarms = Vec::new();
        for element in root.all() {
            if element.path != "MTPAlarmSUCLib/Alarm" {
                continue;
            }
            let trigger = element.value(&["Trigger"]);
            let node = trigger.and_then(|id| self.node_of(id).or_else(|| self.variable_node(id)));
            if trigger.is_some() && node.is_none() {
                self.find(
                    element,
                    &element.name,
                    "its Trigger names no node of the file",
                );
            }
            let text = element.value(&["MessageRef"]);
            let text = text.and_then(|id| texts.get(id)).copied();
            alarms.push(ModuleAlarm {
                id: element.id.clone(),
                name: element.name.clone(),
                text: text.unwrap_or_default().to_owned(),
                severity: element
                    .value(&["Severity"])
                    .and_then(|text| text.parse().ok()),
                is_acknowledged: is_true(element.value(&["AckRequired"])),
                trigger: node,
                trigger_value: element
                    .value(&["TriggerValue"])
                    .unwrap_or_default()
                    .to_owned(),
            });
        }
        alarms
    }

    /// Returns the node of an attribute of a data assembly by the ID of the attribute.
    fn variable_node(&self, id: &str) -> Option<OpcUaNode> {
        self.node_of(self.attribute_value(id)?)
    }
}

fn role_of(element: &CaexElement) -> Option<OutputRole> {
    match element.kind() {
        "ReportValue" => Some(OutputRole::Report),
        "ProcessValueOut" => Some(OutputRole::ProcessValueOut),
        "ProcessValueIn" => Some(OutputRole::ProcessValueIn),
        _ => None,
    }
}

/// The sensors of the standard and of its drafts, which have no family in their paths.
const SENSORS: &[&str] = &[
    "AnaView",
    "BinView",
    "DIntView",
    "StringView",
    "StrView",
    "AnaMon",
    "BinMon",
    "DIntMon",
];
/// The actuators and controllers.
const ACTUATORS: &[&str] = &["AnaVlv", "BinVlv", "AnaDrv", "BinDrv", "PIDCtrl", "SerVlv"];
