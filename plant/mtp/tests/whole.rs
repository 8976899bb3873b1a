//! Every element of a manifest: nodes, servers, sensors, actuators, outputs, equipment, alarms and
//! the state machine, as a model and as RDF.

mod common;

use std::collections::{BTreeMap, BTreeSet};

use common::of_class;
use mtp::vocabulary as v;
use mtp::{Edition, Family, Module, Object, OutputRole, ParameterKind, Triple, ValueBound};
use test_data::{read_foreign, read_own};

/// The elements of a manifest, by their numbers.
#[derive(Debug, PartialEq, Eq)]
struct Counts {
    items: usize,
    servers: usize,
    sensors: usize,
    actuators: usize,
    values: usize,
    reports: usize,
    process_values: usize,
    assemblies: usize,
}

/// Numbers as counted by another XML library: OPCUAItems, servers, sensors, actuators, sensors with
/// V as a node, report values, process values, data assemblies.
const ALL: [(&str, [usize; 8]); 8] = [
    (
        "cps-edp-mixing-1.1.2/Manifest.aml",
        [557, 1, 14, 10, 14, 0, 0, 51],
    ),
    ("huber-v14.1/Manifest.aml", [104, 1, 2, 1, 2, 0, 0, 12]),
    (
        "mtppy-recipe/example_recipe_manifest.aml",
        [328, 1, 4, 0, 4, 4, 0, 16],
    ),
    ("p2o-bucket/Manifest.aml", [0, 0, 2, 0, 0, 0, 0, 2]),
    ("p2o-dosing-1.0.3/Manifest.aml", [252, 1, 8, 5, 8, 0, 0, 21]),
    ("pimad-core/PiMAd-core.0-0-1.aml", [64, 1, 0, 0, 0, 0, 0, 8]),
    (
        "recipol-hc30-siemens/2026-05-18-HC30_Stirring_V8.aml",
        [158, 1, 3, 1, 3, 0, 4, 10],
    ),
    (
        "zvei-stirred-reactor-v1/Manifest.aml",
        [268, 1, 7, 4, 7, 0, 0, 25],
    ),
];

fn counts(module: &Module) -> Counts {
    let family = |family| {
        let all = module.assemblies.iter();
        all.filter(move |assembly| assembly.family == family)
    };
    let procedures = module.services.iter().flat_map(|one| &one.procedures);
    let outputs = procedures.flat_map(|one| &one.outputs);
    Counts {
        items: module.items.len(),
        servers: module.servers.len(),
        sensors: family(Family::Sensor).count(),
        actuators: family(Family::Actuator).count(),
        values: family(Family::Sensor)
            .filter(|one| one.node(&["V"]).is_some())
            .count(),
        reports: outputs.filter(|one| one.role == OutputRole::Report).count(),
        process_values: module.process_values.len(),
        assemblies: module.assemblies.len(),
    }
}

fn counted(
    [
        items,
        servers,
        sensors,
        actuators,
        values,
        reports,
        process_values,
        assemblies,
    ]: [usize; 8],
) -> Counts {
    Counts {
        items,
        servers,
        sensors,
        actuators,
        values,
        reports,
        process_values,
        assemblies,
    }
}

#[test]
fn every_element_of_eight_manifests_is_read() {
    for (file, wanted) in ALL {
        let Some(text) = read_foreign(&format!("mtp/{file}")) else {
            return;
        };
        let module = Module::read(&text).unwrap();
        let wanted = counted(wanted);
        assert_eq!(counts(&module), wanted, "{file}");
        let faults: Vec<_> = module.findings.iter().filter(|one| !one.is_note).collect();
        let lines = text.lines().count();
        assert!(
            faults.iter().all(|one| one.line > 0 && one.line <= lines),
            "{file}: {faults:?}"
        );
        let all = module.triples("urn:m", &BTreeMap::new());
        assert_eq!(of_class(&all, v::OPC_UA_ITEM), wanted.items, "{file}");
        assert_eq!(of_class(&all, v::SENSOR), wanted.sensors, "{file}");
        assert_eq!(of_class(&all, v::ACTUATOR), wanted.actuators, "{file}");
        assert_eq!(of_class(&all, v::SERVER), wanted.servers, "{file}");
        has_every_row(file, &module, &all);
    }
}

/// Checks that each kind of element of the published mapping has individuals in both vocabularies,
/// as far as the manifest has the element.
fn has_every_row(file: &str, module: &Module, all: &[Triple]) {
    let is = |what: &str, wanted: bool, found: usize| {
        assert_eq!(wanted, found > 0, "{file}: {what}: {found}");
    };
    let role = |role| {
        let mut services = module.services.iter();
        services.any(|one| one.control.node(role).is_some())
    };
    let named = |name: &str| {
        let of = all.iter().filter(|one| {
            one.predicate == v::HAS_VARIABLE_NAME && one.object == Object::Text(name.to_owned())
        });
        of.count()
    };
    let parameters: Vec<_> = module
        .services
        .iter()
        .flat_map(|one| {
            let own = one.procedures.iter().flat_map(|one| &one.parameters);
            one.parameters.iter().chain(own)
        })
        .collect();
    let of_parameters = |end: &str| {
        let of = all.iter().filter(|one| {
            one.predicate == v::RDF_TYPE
                && one.object == Object::Iri(v::PAPER_SKILL_PARAMETER.to_owned())
                && one.subject.ends_with(end)
        });
        of.count()
    };
    let procedures = module.services.iter().map(|one| one.procedures.len());
    let procedures: usize = procedures.sum();
    assert_eq!(of_class(all, v::PAPER_MODULE), 1, "{file}");
    assert_eq!(of_class(all, v::PAPER_PROCESS), module.services.len());
    assert_eq!(of_class(all, v::PAPER_SKILL), procedures, "{file}");
    assert_eq!(of_class(all, v::PAPER_SENSOR), of_class(all, v::SENSOR));
    assert_eq!(of_class(all, v::PAPER_ACTUATOR), of_class(all, v::ACTUATOR));
    assert_eq!(of_class(all, v::PAPER_SERVER), module.servers.len());
    assert_eq!(of_class(all, v::PAPER_NODE_SET), module.servers.len());
    assert_eq!(of_class(all, v::PAPER_VARIABLE), module.items.len());
    let has_write = parameters.iter().any(|one| one.write.is_some());
    is(
        "VExt",
        has_write,
        of_class(all, v::INPUT_PARAMETER).min(parameters.len()),
    );
    let has = |bound: fn(&mtp::ServiceParameter) -> &Option<ValueBound>| {
        parameters.iter().any(|one| bound(one).is_some())
    };
    is("VMin", has(|one| &one.min), of_parameters("/Min"));
    is("VMax", has(|one| &one.max), of_parameters("/Max"));
    is("VUnit", has(|one| &one.unit), of_parameters("/Unit"));
    let rows = [
        ("ProcedureExt", mtp::ControlRole::ProcedureWanted),
        ("ProcedureCur", mtp::ControlRole::ProcedureCurrent),
        ("ProcedureReq", mtp::ControlRole::ProcedureRequested),
        ("StateCur", mtp::ControlRole::State),
    ];
    for (name, of) in rows {
        is(name, role(of), named(name));
    }
    let has_command = role(mtp::ControlRole::Command);
    is(
        "CommandExt",
        has_command,
        of_class(all, v::PAPER_SKILL_COMMAND),
    );
    let has_state = role(mtp::ControlRole::State);
    is(
        "state",
        has_state,
        of_class(all, v::PAPER_CURRENT_STATE_OUTPUT),
    );
    let values = counts(module).values;
    let sensors = all.iter().filter(|one| {
        one.predicate == v::PARAMETER_KIND && one.object == Object::Text("sensor".to_owned())
    });
    assert_eq!(sensors.count(), values, "{file}: V");
}

#[test]
fn a_module_of_mtp_2_is_read_whole() {
    let module = Module::read(&read_own("mtp/column.aml")).unwrap();
    assert_eq!(module.edition, Edition::V2);
    assert_eq!((&*module.name, &*module.version), ("Column", "2.1.0"));
    assert_eq!(module.findings, []);
    assert_eq!(
        counts(&module),
        counted([117, 1, 6, 5, 6, 1, 2, 22]),
        "{:?}",
        module.findings
    );
    let [heating, draining] = &*module.services else {
        panic!("{:?}", module.services);
    };
    assert_eq!(heating.control.0.len(), 23);
    let ramp = &heating.procedures[0];
    let kinds: Vec<ParameterKind> = ramp.parameters.iter().map(|one| one.kind).collect();
    assert_eq!(
        kinds,
        [
            ParameterKind::Analog,
            ParameterKind::Integer,
            ParameterKind::Binary,
            ParameterKind::Text
        ]
    );
    let setpoint = &ramp.parameters[0];
    assert_eq!(setpoint.min, Some(ValueBound::Constant(20.0)));
    assert_eq!(setpoint.unit, Some(ValueBound::Constant(1001.0)));
    assert!(!setpoint.is_configuration && heating.parameters[0].is_configuration);
    let outputs: Vec<(&str, OutputRole)> = ramp
        .outputs
        .iter()
        .map(|one| (&*one.name, one.role))
        .collect();
    assert_eq!(
        outputs,
        [
            ("Energy", OutputRole::Report),
            ("Temperature", OutputRole::ProcessValueOut)
        ]
    );
    assert_eq!(ramp.equipment, ["d-Heater"]);
    assert_eq!(draining.procedures.len(), 1);
    let [alarm] = &*module.alarms else {
        panic!("{:?}", module.alarms);
    };
    assert_eq!(
        (alarm.severity, &*alarm.text),
        (Some(700), "The column is almost full")
    );
    assert_eq!(
        alarm.trigger.as_ref().unwrap().id(),
        "nsu=urn:ua-bridge:test:column;s=Level.V"
    );
    // Data assemblies of one name are distinct.
    let health = module.assemblies.iter().filter(|one| one.name == "Health");
    let ids: BTreeSet<&str> = health.map(|one| &*one.id).collect();
    assert_eq!(ids.len(), 2);
    let all = module.triples("urn:m", &BTreeMap::new());
    has_every_row("column.aml", &module, &all);
    assert_eq!(of_class(&all, v::ALARM), 1);
    let equipment = all
        .iter()
        .filter(|one| one.predicate == v::REQUIRES_EQUIPMENT);
    assert_eq!(equipment.count(), 1);
}

#[test]
fn each_service_has_the_state_machine_with_its_values() {
    let module = Module::read(&read_own("mtp/stage.aml")).unwrap();
    let all = module.triples("urn:m", &BTreeMap::new());
    assert_eq!(of_class(&all, v::STATE_MACHINE), 2);
    assert_eq!(of_class(&all, v::STATE), 2 * 16);
    let about = |subject: &str, predicate: &str| {
        let mut of = all.iter();
        let found = of.find(|one| one.subject == subject && one.predicate == predicate);
        found.map(|one| one.object.clone())
    };
    let state = "urn:m/service/e31/machine/state/Execute";
    assert_eq!(about(state, v::STATE_VALUE), Some(Object::Integer(64)));
    let hold = "urn:m/service/e31/machine/transition/Execute.Hold";
    assert_eq!(
        about(hold, v::HAS_TARGET_STATE),
        Some(Object::Iri(
            "urn:m/service/e31/machine/state/Holding".to_owned()
        ))
    );
    let command = "urn:m/service/e31/command/Hold";
    assert_eq!(
        about(hold, v::IS_INVOKED_BY),
        Some(Object::Iri(command.to_owned()))
    );
    assert_eq!(about(command, v::COMMAND_VALUE), Some(Object::Integer(16)));
    assert_eq!(
        about(command, v::ACCESS),
        Some(Object::Text("read and write".to_owned()))
    );
}

#[test]
fn elements_that_are_left_out_are_findings_with_their_lines() {
    let text = read_own("mtp/column.aml");
    let with = |from: &str, to: &str| Module::read(&text.replacen(from, to, 1)).unwrap();
    let faults = |module: Module| -> Vec<String> {
        let faults = module.findings.into_iter().filter(|one| !one.is_note);
        faults.map(|one| one.to_string()).collect()
    };
    let line = |part: &str| {
        let before = text.split(part).next().unwrap();
        before.lines().count()
    };
    // A reference to a node that is missing.
    let found = faults(with("<Value>n-Level.V</Value>", "<Value>n-gone</Value>"));
    let at = line("<Value>n-Level.V</Value>");
    assert_eq!(
        found,
        [
            format!("line {at}: Level.V: it refers to an ID that no OPCUAItem has"),
            format!(
                "line {}: LevelHigh: its Trigger names no node of the file",
                line("Name=\"LevelHigh\"")
            ),
        ]
    );
    let found = faults(with(
        "r-Energy</Value></Attribute></InternalElement><InternalElement Name=\"Temperature\"",
        "r-gone</Value></Attribute></InternalElement><InternalElement Name=\"Temperature\"",
    ));
    assert!(
        found[0]
            .ends_with("Heating/Ramp/Energy: no data assembly with a value belongs to this output"),
        "{found:?}"
    );
    let found = faults(with(
        "<Value>r-Heater</Value></Attribute></InternalElement></InternalElement><InternalElement Name=\"Keep\"",
        "<Value>r-gone</Value></Attribute></InternalElement></InternalElement><InternalElement Name=\"Keep\"",
    ));
    assert!(
        found[0].ends_with("Heating/Ramp/Heater: no data assembly belongs to this equipment"),
        "{found:?}"
    );
    let found = faults(with("<Value>42</Value>", "<Value/>"));
    assert!(
        found[0].ends_with("Numbered: the OPCUAItem has no Identifier or no Namespace"),
        "{found:?}"
    );
}

#[test]
fn documents_of_one_manifest_are_read_together() {
    let text = read_own("mtp/column.aml");
    let at = text.find("<InstanceHierarchy Name=\"Services\">").unwrap();
    let end = text.find("<InstanceHierarchy Name=\"Texts\">").unwrap();
    let services = &text[at..end];
    let link = "<ExternalInterface Name=\"Services\" ID=\"x\" RefBaseClassPath=\"AutomationMLInterfaceClassLib/AutomationMLBaseInterface/ExternalDataConnector\"><Attribute Name=\"refURI\"><Value>./parts/services.aml#s</Value></Attribute></ExternalInterface></InternalElement>\n</InstanceHierarchy>";
    let main =
        text.replace(services, "")
            .replacen("</InternalElement>\n</InstanceHierarchy>", link, 1);
    let part = format!("<CAEXFile>{services}</CAEXFile>");
    let whole = Module::read(&text).unwrap();
    let mut asked = Vec::new();
    let joined = Module::from_files(main.as_bytes(), &mut |name| {
        asked.push(name.to_owned());
        Some(part.clone().into_bytes())
    });
    let joined = joined.unwrap();
    assert_eq!(asked, ["parts/services.aml"]);
    assert_eq!(joined.services, whole.services);
    let missing = Module::from_bytes(main.as_bytes()).unwrap();
    assert!(missing.services.is_empty());
    let fault = missing.findings.iter().find(|one| !one.is_note).unwrap();
    assert_eq!(
        (&*fault.about, &*fault.what),
        (
            "parts/services.aml",
            "the manifest refers to this document, which is missing"
        )
    );
}

#[test]
fn statements_are_written_as_n_triples() {
    let triple = |object| Triple {
        subject: "urn:s".to_owned(),
        predicate: "urn:p".to_owned(),
        object,
    };
    let cases = [
        (Object::Iri("urn:o".to_owned()), "<urn:o>"),
        (
            Object::Text("a \"b\"\n\\ \u{7}ü".to_owned()),
            "\"a \\\"b\\\"\\n\\\\ \\u0007ü\"",
        ),
        (
            Object::Integer(-3),
            "\"-3\"^^<http://www.w3.org/2001/XMLSchema#integer>",
        ),
        (
            Object::Number(1.5),
            "\"1.5E0\"^^<http://www.w3.org/2001/XMLSchema#double>",
        ),
        (
            Object::Boolean(true),
            "\"true\"^^<http://www.w3.org/2001/XMLSchema#boolean>",
        ),
    ];
    for (object, text) in cases {
        assert_eq!(
            triple(object).to_string(),
            format!("<urn:s> <urn:p> {text} .")
        );
    }
}
