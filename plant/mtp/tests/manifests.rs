//! Manifests of this project and of six manufacturers, and their inconsistencies.
#![expect(clippy::unwrap_used, reason = "a test may")]

use mtp::{
    ControlRole, ManifestError, Module, MtpService, NodeIdentifier, ParameterKind, Procedure,
    ValueBound,
};
use test_data::{read_foreign, read_own};

/// Returns the module of a manifest of this project.
fn own(file: &str) -> Module {
    Module::read(&read_own(&format!("mtp/{file}"))).unwrap()
}

/// Returns the text of a manifest of another manufacturer.
fn manifest(file: &str) -> Option<String> {
    read_foreign(&format!("mtp/{file}"))
}

fn service<'a>(module: &'a Module, name: &str) -> &'a MtpService {
    module
        .services
        .iter()
        .find(|service| service.name == name)
        .unwrap()
}

fn procedure<'a>(service: &'a MtpService, name: &str) -> &'a Procedure {
    service
        .procedures
        .iter()
        .find(|procedure| procedure.name == name)
        .unwrap()
}

/// Manifests of this project, counted by hand.
const OWN: [(&str, &str, usize, usize, usize); 2] = [
    ("stage.aml", "Stage:1.0.0", 2, 6, 4),
    ("mixer.aml", "Mixer", 1, 2, 4),
];

const ALL: [(&str, &str, usize, usize, usize); 8] = [
    // File, name, services, procedures and parameters, as counted by another XML library. A
    // parameter that two strategies require counts for each of them.
    (
        "cps-edp-mixing-1.1.2/Manifest.aml",
        "Mixing.(1.1.2)",
        10,
        23,
        27,
    ),
    ("huber-v14.1/Manifest.aml", "Huber_Temperierer", 2, 3, 6),
    (
        "mtppy-recipe/example_recipe_manifest.aml",
        "mtp_test",
        1,
        3,
        8,
    ),
    ("p2o-bucket/Manifest.aml", "P2O-Bucket", 0, 0, 0),
    (
        "p2o-dosing-1.0.3/Manifest.aml",
        "MTP_Dosiermodul_(1.0.3.0)_WAGO.(1.0.3.0)",
        4,
        5,
        4,
    ),
    (
        "pimad-core/PiMAd-core.0-0-1.aml",
        "PiMAd-core:0.0.1",
        2,
        6,
        0,
    ),
    (
        "recipol-hc30-siemens/2026-05-18-HC30_Stirring_V8.aml",
        "No Information",
        1,
        2,
        1,
    ),
    (
        "zvei-stirred-reactor-v1/Manifest.aml",
        "Rührreaktor_V15",
        4,
        8,
        10,
    ),
];

/// Returns the name and the numbers of services, procedures and parameters.
fn counts(module: &Module) -> (&str, usize, usize, usize) {
    let of_services = module
        .services
        .iter()
        .map(|service| service.parameters.len());
    let all: Vec<_> = module
        .services
        .iter()
        .flat_map(|service| &service.procedures)
        .collect();
    let of_procedures = all.iter().map(|procedure| procedure.parameters.len());
    (
        &module.name,
        module.services.len(),
        all.len(),
        of_services.sum::<usize>() + of_procedures.sum::<usize>(),
    )
}

/// Returns the number of services with nodes for commands and monitoring.
fn commanded(module: &Module) -> usize {
    let roles = [
        ControlRole::Command,
        ControlRole::CommandEnabled,
        ControlRole::State,
        ControlRole::ProcedureWanted,
    ];
    let is_whole = |service: &&MtpService| {
        roles
            .iter()
            .all(|role| service.control.node(*role).is_some())
    };
    module.services.iter().filter(is_whole).count()
}

#[test]
fn every_service_procedure_and_parameter_is_read() {
    for (file, name, services, procedures, parameters) in OWN {
        let module = own(file);
        let wanted = (name, services, procedures, parameters);
        assert_eq!(counts(&module), wanted, "{file}: {:?}", module.findings);
        assert_eq!(module.findings, [], "{file}");
    }
}

#[test]
fn every_service_procedure_and_parameter_of_eight_manifests_is_read() {
    for (file, name, services, procedures, parameters) in ALL {
        let Some(text) = manifest(file) else { return };
        let module = Module::read(&text).unwrap();
        let wanted = (name, services, procedures, parameters);
        assert_eq!(counts(&module), wanted, "{file}: {:?}", module.findings);
    }
}

#[test]
fn each_service_can_be_commanded_and_watched_whatever_its_nodes_are_called() {
    for (file, _, services, ..) in OWN {
        assert_eq!(commanded(&own(file)), services, "{file}");
    }
}

#[test]
fn each_service_of_eight_manifests_can_be_commanded_and_watched() {
    for (file, _, services, ..) in ALL {
        let Some(text) = manifest(file) else { return };
        let module = Module::read(&text).unwrap();
        let found = commanded(&module);
        assert_eq!(found, services, "{file}: {:?}", module.findings);
    }
}

#[test]
fn a_node_is_found_by_endpoint_namespace_and_identifier() {
    let module = own("stage.aml");
    assert_eq!(module.endpoints, ["opc.tcp://127.0.0.1:4840"]);
    let state = service(&module, "Duet")
        .control
        .node(ControlRole::State)
        .unwrap();
    assert_eq!(state.endpoint, "opc.tcp://127.0.0.1:4840");
    assert_eq!(state.namespace, "urn:ua-bridge:test:stage");
    assert!(
        matches!(&state.identifier, NodeIdentifier::Text(text) if text.ends_with("StateCur")),
        "{state:?}"
    );
    assert!(state.access.reads && !state.access.writes);
    let command = service(&module, "Duet")
        .control
        .node(ControlRole::Command)
        .unwrap();
    assert!(command.access.writes);
}

#[test]
fn two_services_with_procedures_of_one_name_stay_apart() {
    let module = own("stage.aml");
    let waltz = |of: &str| procedure(service(&module, of), "Waltz").clone();
    assert_ne!(waltz("Duet").id, waltz("Solo").id);
    let (number, is_default) = (waltz("Duet").number, waltz("Duet").is_default);
    assert_eq!((number, is_default), (1, true));
    assert!(procedure(service(&module, "Solo"), "Polka").is_self_completing);
}

#[test]
fn parameters_of_a_strategy_are_those_it_requires() {
    let module = own("mixer.aml");
    let stirring = service(&module, "Stir");
    let names = |name: &str| -> Vec<String> {
        let parameters = &procedure(stirring, name).parameters;
        parameters
            .iter()
            .map(|parameter| parameter.name.clone())
            .collect()
    };
    assert_eq!(names("by_volume"), ["Volume", "Speed"]);
    assert_eq!(names("continuous"), ["Speed"]);
    let own = stirring.parameters.iter().map(|one| &*one.name);
    assert_eq!(
        own.collect::<Vec<_>>(),
        ["Slow start"],
        "no strategy names it"
    );
    let volume = &procedure(stirring, "by_volume").parameters[0];
    assert_eq!(volume.kind, ParameterKind::Analog);
    assert!(
        volume.write.as_ref().is_some_and(|node| node.access.writes),
        "{volume:?}"
    );
    assert!(matches!(volume.max, Some(ValueBound::Node(_))));
}

#[test]
fn limits_that_the_file_tells_are_numbers() {
    let module = own("stage.aml");
    let parameters = module.services.iter().flat_map(|service| {
        let own = service
            .procedures
            .iter()
            .flat_map(|procedure| &procedure.parameters);
        service.parameters.iter().chain(own)
    });
    let ramp: Vec<_> = parameters
        .filter(|parameter| parameter.max == Some(ValueBound::Constant(180.0)))
        .collect();
    assert!(!ramp.is_empty());
    assert!(
        ramp.iter()
            .all(|parameter| parameter.unit == Some(ValueBound::Constant(1054.0))),
        "seconds"
    );
}

#[test]
fn a_manifest_cut_in_half_is_refused_with_its_line_and_never_panics() {
    let text = read_own("mtp/stage.aml");
    for part in 1..40 {
        let mut end = text.len() * part / 40;
        while !text.is_char_boundary(end) {
            end -= 1;
        }
        let lines = text[..end].lines().count();
        match Module::read(&text[..end]) {
            Err(ManifestError::Xml { line, .. }) => {
                assert!(line <= lines + 1, "{line} of {lines}");
            }
            other => panic!("{part}: {other:?}"),
        }
    }
}

#[test]
fn what_is_no_manifest_is_told() {
    assert_eq!(Module::read("<CAEXFile/>"), Err(ManifestError::NoModule));
    let other = Module::read("a: yaml\n");
    assert!(matches!(other, Err(ManifestError::Xml { .. })), "{other:?}");
    let deep = "<InternalElement>".repeat(100);
    let deep = Module::read(&deep).unwrap_err().to_string();
    assert!(deep.contains("deep"), "{deep}");
    for name in ["Name", "ID", "RefBaseSystemUnitPath"] {
        let long = |length: usize| {
            let value = "a".repeat(length);
            Module::read(&format!(
                "<CAEXFile>\n<InternalElement {name}=\"{value}\"/></CAEXFile>"
            ))
        };
        assert_eq!(long(4096), Err(ManifestError::NoModule));
        let fault = long(4097).unwrap_err().to_string();
        let wanted = format!("line 2: its {name} has more than 4096 bytes");
        assert_eq!(fault, wanted);
    }
    let bomb = "<!DOCTYPE a [<!ENTITY b \"b\">]><CAEXFile/>";
    assert!(matches!(
        Module::read(bomb),
        Err(ManifestError::Xml { line: 1, .. })
    ));
}

#[test]
fn what_does_not_hold_together_is_found_and_the_rest_counts() {
    let text = r#"<CAEXFile><InstanceHierarchy Name="a">
        <InternalElement Name="M" ID="1" RefBaseSystemUnitPath="MTPSUCLib/ModuleTypePackage"/>
        <InternalElement Name="Stir &amp; heat" ID="2" RefBaseSystemUnitPath="MTPServiceSUCLib/Service">
          <InternalElement Name="Slow" ID="3" RefBaseSystemUnitPath="MTPServiceSUCLib/ServiceProcedure">
            <Attribute Name="ProcedureID"><Value>1</Value></Attribute>
            <InternalElement Name="Speed" ID="5" RefBaseSystemUnitPath="MTPServiceSUCLib/ServiceParameter/ProcedureParameter"/>
          </InternalElement>
          <InternalElement Name="Fast" ID="4" RefBaseSystemUnitPath="MTPServiceSUCLib/ServiceProcedure"/>
        </InternalElement></InstanceHierarchy></CAEXFile>"#;
    let module = Module::read(text).unwrap();
    assert_eq!(module.services.len(), 1);
    assert_eq!(module.services[0].name, "Stir & heat");
    let names: Vec<_> = module.services[0]
        .procedures
        .iter()
        .map(|procedure| &*procedure.name)
        .collect();
    assert_eq!(names, ["Slow"]);
    let about: Vec<_> = module
        .findings
        .iter()
        .map(|finding| &*finding.about)
        .collect();
    assert_eq!(
        about,
        ["Stir & heat", "Stir & heat/Slow/Speed", "Stir & heat/Fast"]
    );
}
