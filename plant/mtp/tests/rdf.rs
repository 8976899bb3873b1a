//! Manifests of this project and of other manufacturers as RDF, and two modules of the same name.
#![expect(clippy::unwrap_used, reason = "a test may")]

use std::collections::{BTreeMap, BTreeSet};

use mtp::vocabulary as v;
use mtp::{Module, Object, Triple};
use test_data::{read_foreign, read_own};

/// Returns the module of a manifest of this project.
fn own(file: &str) -> Module {
    Module::read(&read_own(&format!("mtp/{file}"))).unwrap()
}

/// Returns the module of a manifest of another manufacturer.
fn manifest(name: &str) -> Option<Module> {
    Some(Module::read(&read_foreign(&format!("mtp/{name}"))?).unwrap())
}

fn about<'a>(all: &'a [Triple], predicate: &str, object: &str) -> Vec<&'a str> {
    let said = all.iter().filter(|triple| triple.predicate == predicate);
    said.filter(
        |triple| matches!(&triple.object, Object::Iri(text) | Object::Text(text) if text == object),
    )
    .map(|triple| &*triple.subject)
    .collect()
}

fn of<'a>(all: &'a [Triple], subject: &str, predicate: &str) -> Vec<&'a Object> {
    all.iter()
        .filter(|triple| triple.subject == subject && triple.predicate == predicate)
        .map(|triple| &triple.object)
        .collect()
}

const ALL: [(&str, usize, usize); 8] = [
    ("cps-edp-mixing-1.1.2/Manifest.aml", 10, 23),
    ("huber-v14.1/Manifest.aml", 2, 3),
    ("mtppy-recipe/example_recipe_manifest.aml", 1, 3),
    ("p2o-bucket/Manifest.aml", 0, 0),
    ("p2o-dosing-1.0.3/Manifest.aml", 4, 5),
    ("pimad-core/PiMAd-core.0-0-1.aml", 2, 6),
    ("recipol-hc30-siemens/2026-05-18-HC30_Stirring_V8.aml", 1, 2),
    ("zvei-stirred-reactor-v1/Manifest.aml", 4, 8),
];

#[test]
fn each_procedure_is_a_skill_with_a_capability_and_a_node() {
    are_skills(&own("stage.aml"), ("stage.aml", 2, 6));
    are_skills(&own("mixer.aml"), ("mixer.aml", 1, 2));
}

#[test]
fn each_procedure_of_eight_manifests_is_a_skill_with_a_capability_and_a_node() {
    for (file, services, procedures) in ALL {
        let Some(module) = manifest(file) else { return };
        are_skills(&module, (file, services, procedures));
    }
}

/// Checks that each procedure of a module is a skill.
fn are_skills(module: &Module, (file, services, procedures): (&str, usize, usize)) {
    let all = module.triples("urn:example:module", &BTreeMap::new());
    let skills: BTreeSet<_> = about(&all, v::RDF_TYPE, v::SKILL).into_iter().collect();
    assert_eq!(skills.len(), procedures, "{file}");
    assert_eq!(
        about(&all, v::RDF_TYPE, v::SERVICE).len(),
        services,
        "{file}"
    );
    for skill in skills {
        assert_eq!(
            of(&all, "urn:example:module", v::PROVIDES_SKILL)
                .iter()
                .filter(|object| ***object == Object::Iri(skill.to_owned()))
                .count(),
            1
        );
        let node = of(&all, skill, v::NODE_ID);
        assert!(
            matches!(&*node, [Object::Text(id)] if id.starts_with("nsu=") || id.starts_with("ns=")),
            "{file} {skill}: {node:?}"
        );
        assert_eq!(of(&all, skill, v::ENDPOINT).len(), 1, "{file} {skill}");
        let realised = all.iter().any(|triple| {
            triple.predicate == v::IS_REALIZED_BY_SKILL
                && triple.object == Object::Iri(skill.to_owned())
        });
        assert!(realised, "{file} {skill}");
    }
}

#[test]
fn each_parameter_has_a_name_a_type_and_what_limits_the_file_tells() {
    let module = own("stage.aml");
    let all = module.triples("urn:example:stage", &BTreeMap::new());
    let ramp = all
        .iter()
        .find(|triple| triple.predicate == v::MAX && triple.object == Object::Number(180.0))
        .unwrap();
    let text = |predicate| of(&all, &ramp.subject, predicate);
    assert_eq!(text(v::HAS_VARIABLE_TYPE), [&Object::Text("Float".into())]);
    assert_eq!(text(v::UNIT), [&Object::Text("s".into())]);
    assert_eq!(text(v::UNIT_CODE), [&Object::Integer(1054)]);
    assert_eq!(text(v::HAS_VARIABLE_NAME).len(), 1);
    let holders = all.iter().filter(|triple| {
        triple.predicate == v::HAS_INPUT_PARAMETER
            && triple.object == Object::Iri(ramp.subject.clone())
    });
    assert!(holders.count() > 0);
}

#[test]
fn two_modules_of_one_manifest_share_nothing_but_words() {
    let module = own("stage.aml");
    let subjects = |base: &str| -> BTreeSet<String> {
        module
            .triples(base, &BTreeMap::new())
            .into_iter()
            .map(|triple| triple.subject)
            .collect()
    };
    let (one, other) = (subjects("urn:example:one"), subjects("urn:example:other"));
    assert_eq!(one.len(), other.len());
    assert_eq!(
        one.intersection(&other).collect::<Vec<_>>(),
        Vec::<&String>::new()
    );
}

#[test]
fn procedures_of_one_name_in_two_services_have_commands_of_their_own() {
    let module = own("stage.aml");
    let all = module.triples("urn:example:stage", &BTreeMap::new());
    let starts: BTreeSet<_> = about(&all, v::RDFS_LABEL, "Start").into_iter().collect();
    assert_eq!(starts.len(), 2, "one for each service: {starts:?}");
    for start in starts {
        assert_eq!(of(&all, start, v::COMMAND_VALUE), [&Object::Integer(4)]);
    }
}

#[test]
fn things_without_an_id_or_with_the_same_one_stay_apart() {
    let text = r#"<CAEXFile><InstanceHierarchy Name="a">
        <InternalElement Name="M" ID="1" RefBaseSystemUnitPath="MTPSUCLib/ModuleTypePackage"/>
        <InternalElement Name="Stir" RefBaseSystemUnitPath="MTPServiceSUCLib/Service">
          <InternalElement Name="Slow" ID="3" RefBaseSystemUnitPath="MTPServiceSUCLib/ServiceProcedure"><Attribute Name="ProcedureID"><Value>1</Value></Attribute></InternalElement>
          <InternalElement Name="Fast" ID="3" RefBaseSystemUnitPath="MTPServiceSUCLib/ServiceProcedure"><Attribute Name="ProcedureID"><Value>2</Value></Attribute></InternalElement>
        </InternalElement>
        <InternalElement Name="Stir" RefBaseSystemUnitPath="MTPServiceSUCLib/Service"/></InstanceHierarchy></CAEXFile>"#;
    let all = Module::read(text)
        .unwrap()
        .triples("urn:m", &BTreeMap::new());
    let skills: BTreeSet<_> = about(&all, v::RDF_TYPE, v::SKILL).into_iter().collect();
    assert_eq!(
        skills,
        BTreeSet::from([
            "urn:m/service/Stir/procedure/3",
            "urn:m/service/Stir/procedure/3,2"
        ])
    );
    let services: BTreeSet<_> = about(&all, v::RDF_TYPE, v::SERVICE).into_iter().collect();
    assert_eq!(
        services,
        BTreeSet::from(["urn:m/service/Stir", "urn:m/service/Stir,2"])
    );
}

#[test]
fn a_service_is_a_capability_of_the_plant_where_that_is_told() {
    let module = own("stage.aml");
    let dance = "urn:example:capability:dance".to_owned();
    let told = BTreeMap::from([("Duet/Waltz".to_owned(), vec![dance.clone()])]);
    let all = module.triples("urn:example:stage", &told);
    let able = about(&all, v::RDF_TYPE, &dance);
    assert_eq!(able.len(), 1, "{able:?}");
    let untold = module.triples("urn:example:stage", &BTreeMap::new());
    assert!(about(&untold, v::RDF_TYPE, &dance).is_empty());
}

#[test]
fn node_ids_are_written_so_that_they_can_be_read_back() {
    let node = mtp::OpcUaNode {
        item: "n".into(),
        endpoint: "opc.tcp://127.0.0.1".into(),
        namespace: "urn:a;b%".into(),
        identifier: mtp::NodeIdentifier::Text("x;y".into()),
        access: mtp::ItemAccess {
            reads: true,
            writes: true,
        },
    };
    assert_eq!(node.id(), "nsu=urn:a%3Bb%25;s=x;y");
    let by_index = mtp::OpcUaNode {
        namespace: "3".into(),
        identifier: mtp::NodeIdentifier::Numeric(7),
        ..node
    };
    assert_eq!(by_index.id(), "ns=3;i=7");
}
