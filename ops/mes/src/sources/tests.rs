use std::path::PathBuf;

use super::*;

#[test]
fn an_rml_mapping_of_the_yaml_is_a_source_and_its_faults_are_findings() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/plant");
    let yaml = |rml: &str| {
        let text = format!("mes: m\napplication_uri: urn:x\nnamespace: 5\nrml: [{rml}]\n");
        Settings::from_yaml(&text, &folder).unwrap()
    };
    let knowledge = Arc::new(Knowledge::new().unwrap());
    let sources = MesSources::new(Arc::clone(&knowledge));
    let statements = |name: &str| {
        let all = knowledge.sources();
        let found = all.iter().find(|source| source.name == name);
        found.map(|source| source.statements)
    };

    sources.read(&yaml("parts.rml.ttl"));
    assert_eq!(sources.findings(), []);
    assert_eq!(statements("parts.rml.ttl"), Some(10));

    sources.read(&yaml(
        "{mapping: parts.rml.ttl, file: parts.xml, name: parts}",
    ));
    assert_eq!(statements("parts.rml.ttl"), None, "it left the YAML");
    assert_eq!(statements("parts"), Some(10));

    sources.read(&yaml(
        "{mapping: parts.rml.ttl, file: mes.yaml, name: parts}",
    ));
    let findings = sources.findings();
    let [found] = findings.as_slice() else {
        panic!("{findings:?}")
    };
    assert!(found.refused);
    let place = "parts.rml.ttl: triples map <urn:example:parts:Parts>: source `parts.xml`: line 1";
    assert!(found.what.contains(place), "{}", found.what);
}

#[test]
fn a_check_has_the_lines_of_the_findings_and_changes_nothing() {
    let knowledge = Arc::new(Knowledge::new().unwrap());
    let sources = MesSources::new(Arc::clone(&knowledge));
    let before = *knowledge.changes().borrow();
    let check = |kind, contents: &[u8]| sources.check(kind, "a", contents);
    let good = check(SourceKind::File, b"<urn:a> <urn:p> 1 .");
    assert_eq!(
        (good.accepted, good.replaces, good.findings.len()),
        (true, false, 0)
    );
    for (kind, contents, line) in [
        (SourceKind::File, &b"<urn:a>\n<urn:p> ."[..], Some(2)),
        (SourceKind::File, &b"<urn:a> <urn:p> 1 .\n\xff"[..], Some(2)),
        (SourceKind::NodeSet, &b"<UANodeSet>\n</other>"[..], None),
        (SourceKind::Mtp, &b"<CAEXFile>"[..], None),
        (SourceKind::Run, &b""[..], None),
    ] {
        let bad = check(kind, contents);
        let [found] = bad.findings.as_slice() else {
            panic!("{bad:?}")
        };
        assert!(!bad.accepted && found.refused, "{bad:?}");
        assert!(line.is_none() || found.line == line, "{bad:?}");
    }
    assert_eq!(*knowledge.changes().borrow(), before);
    SourceFiles::put(&sources, SourceKind::File, "a", b"<urn:a> <urn:p> 1 .").unwrap();
    assert!(check(SourceKind::File, b"<urn:a> <urn:p> 2 .").replaces);
    let manifest = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/data/mtp/stage.aml");
    let manifest = check(SourceKind::Mtp, &std::fs::read(manifest).unwrap());
    assert!(manifest.accepted, "{manifest:?}");
    assert!(manifest.findings.iter().all(|found| found.line.is_some()));
}

/// Writes a NodeSet of a date that requires others.
fn write_node_set(folder: &Path, namespace: &str, date: &str, required: &[&str]) {
    let required: String = required
        .iter()
        .map(|other| {
            format!("<RequiredModel ModelUri=\"{other}\" PublicationDate=\"2022-01-01\"/>")
        })
        .collect();
    let text = format!(
        "<UANodeSet><NamespaceUris><Uri>{namespace}</Uri></NamespaceUris>
         <Models><Model ModelUri=\"{namespace}\" PublicationDate=\"{date}\">{required}</Model></Models>
         <UAObjectType NodeId=\"ns=1;i=1\" BrowseName=\"1:T\"/></UANodeSet>"
    );
    std::fs::create_dir_all(folder).unwrap();
    let name = namespace.replace(':', "-");
    std::fs::write(folder.join(format!("{name}.xml")), text).unwrap();
}

#[test]
fn nodesets_are_completed_from_a_folder_and_leave_with_their_reason() {
    let folder = std::env::temp_dir().join(format!("mes-nodesets-{}", std::process::id()));
    drop(std::fs::remove_dir_all(&folder));
    write_node_set(
        &folder,
        "urn:robotics",
        "2023-01-01",
        &["urn:di", "urn:none"],
    );
    write_node_set(&folder, "urn:late", "2023-01-01", &["urn:extra", "urn:di"]);
    write_node_set(
        &folder.join("sets/di"),
        "urn:di",
        "2020-01-01",
        &["urn:core"],
    );
    write_node_set(&folder.join("sets"), "urn:core", "2022-01-01", &[]);
    write_node_set(&folder.join("sets"), "urn:extra", "2022-01-01", &[]);
    std::fs::write(folder.join("sets/other.xml"), "<other/>").unwrap();
    let yaml = |keys: &str| {
        let text = format!("mes: m\napplication_uri: urn:x\nnamespace: 5\n{keys}\n");
        Settings::from_yaml(&text, &folder).unwrap()
    };
    let knowledge = Arc::new(Knowledge::new().unwrap());
    let sources = MesSources::new(Arc::clone(&knowledge));
    let names = || {
        let all = knowledge.sources().into_iter();
        let all = all.filter(|one| one.kind == SourceKind::NodeSet && one.name.starts_with("urn:"));
        let all = all.filter(|one| one.name != skills::model::NAMESPACE);
        all.map(|one| one.name).collect::<BTreeSet<_>>()
    };
    let set = |all: &[&str]| {
        all.iter()
            .map(|one| (*one).to_owned())
            .collect::<BTreeSet<_>>()
    };

    sources.read(&yaml("nodesets: [urn-robotics.xml]\nnodeset_folder: sets"));
    assert_eq!(names(), set(&["urn:robotics", "urn:di", "urn:core"]));
    let findings = sources.findings();
    let [old, missing] = findings.as_slice() else {
        panic!("{findings:?}")
    };
    assert!(
        old.what.contains("the newest in") && old.what.contains("2020-01-01"),
        "{old:?}"
    );
    assert!(missing.what.contains("requires urn:none"), "{missing:?}");
    assert!(
        findings
            .iter()
            .all(|one| one.source == "urn:robotics" && !one.refused)
    );

    // A NodeSet that is added while the program runs is completed too, and a check says what lacks.
    let late = std::fs::read(folder.join("urn-late.xml")).unwrap();
    let checked = sources.check(SourceKind::NodeSet, "late", &late);
    assert!(
        checked.accepted && checked.findings[0].what.contains("urn:di"),
        "{checked:?}"
    );
    SourceFiles::put(&sources, SourceKind::NodeSet, "late", &late).unwrap();
    assert!(names().contains("urn:late") && names().contains("urn:extra"));

    // Completions leave the graph with the last NodeSet that requires them.
    sources.read(&yaml("nodeset_folder: sets"));
    let of_late = ["urn:late", "urn:extra", "urn:di", "urn:core"];
    assert_eq!(names(), set(&of_late));
    sources.remove(SourceKind::NodeSet, "urn:late").unwrap();
    sources.remove(SourceKind::NodeSet, "urn:di").unwrap();
    sources.read(&yaml("nodeset_folder: sets"));
    assert_eq!(names(), set(&["urn:extra", "urn:core"]));
    sources.read(&yaml("nodeset_folder: nowhere"));
    let findings = sources.findings();
    assert!(
        findings
            .iter()
            .any(|one| one.refused && one.what.contains("nowhere")),
        "{findings:?}"
    );
    drop(std::fs::remove_dir_all(&folder));
}

/// Returns an empty folder that is named for a test, and settings of files in it.
fn plant(name: &str) -> (PathBuf, impl Fn(&str) -> Settings) {
    let folder = std::env::temp_dir().join(format!("{name}-{}", std::process::id()));
    drop(std::fs::remove_dir_all(&folder));
    let of_yaml = folder.clone();
    let settings = move |keys: &str| {
        let text = format!("mes: m\napplication_uri: urn:x\nnamespace: 5\n{keys}\n");
        Settings::from_yaml(&text, &of_yaml).unwrap()
    };
    (folder, settings)
}

#[test]
fn nodesets_remain_while_their_folder_cannot_be_read() {
    let (folder, yaml) = plant("mes-nodesets-away");
    write_node_set(&folder, "urn:robotics", "2023-01-01", &["urn:di"]);
    write_node_set(&folder.join("sets"), "urn:di", "2022-01-01", &["urn:core"]);
    write_node_set(&folder.join("sets"), "urn:core", "2022-01-01", &[]);
    let yaml = yaml("nodesets: [urn-robotics.xml]\nnodeset_folder: sets");
    let knowledge = Arc::new(Knowledge::new().unwrap());
    let sources = MesSources::new(Arc::clone(&knowledge));
    let is_there = |name: &str| knowledge.sources().iter().any(|one| one.name == name);
    sources.read(&yaml);
    assert_eq!(sources.findings(), []);
    for _ in 0..2 {
        std::fs::rename(folder.join("sets"), folder.join("away")).unwrap();
        // Each signal is one more reading.
        for _ in 0..2 {
            sources.read(&yaml);
            assert!(is_there("urn:di") && is_there("urn:core"));
            let findings = sources.findings();
            let mut findings = findings.iter();
            assert!(findings.any(|one| one.refused && one.what.contains("cannot read the folder")));
        }
        std::fs::rename(folder.join("away"), folder.join("sets")).unwrap();
        sources.read(&yaml);
        assert_eq!(sources.findings(), [], "it can be read again");
    }
    drop(std::fs::remove_dir_all(&folder));
}

#[test]
fn an_older_nodeset_completes_others_if_the_newest_cannot_be_read() {
    let (folder, yaml) = plant("mes-nodesets-broken");
    let (sets, broken) = (folder.join("sets"), folder.join("sets/broken"));
    write_node_set(&folder, "urn:robotics", "2023-01-01", &["urn:di"]);
    write_node_set(&sets, "urn:di", "2022-01-01", &[]);
    write_node_set(&broken, "urn:di", "2024-01-01", &[]);
    let file = broken.join("urn-di.xml");
    let text = std::fs::read_to_string(&file).unwrap();
    let damaged = text.replace("</UANodeSet>", "");
    std::fs::write(&file, &damaged).unwrap();
    let knowledge = Arc::new(Knowledge::new().unwrap());
    let sources = MesSources::new(Arc::clone(&knowledge));
    let yaml = yaml("nodesets: [urn-robotics.xml]\nnodeset_folder: sets");
    sources.read(&yaml);
    let version = knowledge.model_version("urn:di");
    assert_eq!(version.publication_date, "2022-01-01");
    let findings = sources.findings();
    let [found] = findings.as_slice() else {
        panic!("{findings:?}")
    };
    assert!(found.source == "urn:di" && !found.refused, "{found:?}");
    assert!(found.what.contains("broken"), "{found:?}");

    // Contents that a file gave before remain while it is damaged.
    for (text, findings) in [(&text, 0), (&damaged, 1)] {
        std::fs::write(&file, text).unwrap();
        sources.read(&yaml);
        let version = knowledge.model_version("urn:di");
        assert_eq!(version.publication_date, "2024-01-01");
        assert_eq!(sources.findings().len(), findings);
    }
    drop(std::fs::remove_dir_all(&folder));
}

#[test]
fn a_stored_nodeset_that_is_too_old_is_a_finding_after_a_restart() {
    let (folder, yaml) = plant("mes-nodesets-stored");
    write_node_set(&folder, "urn:robotics", "2023-01-01", &["urn:di"]);
    write_node_set(&folder, "urn:di", "2020-01-01T00:00:00Z", &[]);
    let yaml = yaml("nodesets: [urn-robotics.xml]\nnodeset_folder: .");
    let stored = folder.join("stored");
    {
        let (knowledge, _) = Knowledge::open(&stored).unwrap();
        let sources = MesSources::new(Arc::new(knowledge));
        let di = std::fs::read(folder.join("urn-di.xml")).unwrap();
        SourceFiles::put(&sources, SourceKind::NodeSet, "di", &di).unwrap();
    }
    let (knowledge, _) = Knowledge::open(&stored).unwrap();
    let sources = MesSources::new(Arc::new(knowledge));
    sources.read(&yaml);
    let findings = sources.findings();
    let [found] = findings.as_slice() else {
        panic!("{findings:?}")
    };
    let text = "the given NodeSet has the version of 2020-01-01";
    assert!(found.what.contains(text), "{found:?}");
    drop(std::fs::remove_dir_all(&folder));
}

#[test]
fn a_nodeset_that_was_added_incomplete_is_completed_after_a_restart() {
    let (folder, yaml) = plant("mes-nodesets-incomplete");
    write_node_set(&folder, "urn:late", "2023-01-01", &["urn:di"]);
    write_node_set(&folder.join("sets"), "urn:di", "2023-01-01", &["urn:core"]);
    write_node_set(&folder.join("sets"), "urn:core", "2023-01-01", &[]);
    let stored = folder.join("stored");
    // Returns the sources of the program after a start, without those that it has itself.
    let started = |keys: &str| {
        let (knowledge, _) = Knowledge::open(&stored).unwrap();
        let sources = MesSources::new(Arc::new(knowledge));
        sources.read(&yaml(keys));
        sources
    };
    let names = |sources: &MesSources| {
        let known = sources.known_node_sets().into_keys();
        known
            .filter(|name| *name != skills::model::NAMESPACE)
            .collect::<Vec<_>>()
    };
    {
        let sources = started("");
        let late = std::fs::read(folder.join("urn-late.xml")).unwrap();
        SourceFiles::put(&sources, SourceKind::NodeSet, "late", &late).unwrap();
        assert_eq!(names(&sources), ["urn:late"]);
    }
    {
        let sources = started("nodeset_folder: http://127.0.0.1:1/{uri}.xml");
        let findings = sources.findings();
        let [found] = findings.as_slice() else {
            panic!("{findings:?}")
        };
        let text = "urn:late requires urn:di, which is fetched from http://127.0.0.1:1/";
        assert!(found.what.starts_with(text), "{found:?}");
    }
    {
        let sources = started("nodeset_folder: sets");
        assert_eq!(names(&sources), ["urn:core", "urn:di", "urn:late"]);
        assert_eq!(sources.findings(), []);
    }
    // They are lasting, as the NodeSet that requires them.
    let sources = started("");
    assert_eq!(names(&sources), ["urn:core", "urn:di", "urn:late"]);
    drop(std::fs::remove_dir_all(&folder));
}

#[test]
fn a_step_file_gives_a_process_the_width_of_its_part() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/plant");
    let text = include_str!("../../../../examples/plant/grip-cover.yaml");
    let settings = Settings::from_yaml(text, &folder).unwrap();
    let knowledge = Arc::new(Knowledge::new().unwrap());
    let sources = MesSources::new(Arc::clone(&knowledge));
    sources.read(&settings);
    assert_eq!(sources.findings(), []);
    let given = &settings.processes[0].steps[0].parameters[0];
    let query = given.query.as_ref().unwrap();
    let query = ::knowledge::ValueQuery::read(&query.sparql).unwrap();
    let width = query.value(&knowledge).unwrap();
    assert!((width.as_f64().unwrap() - 0.041).abs() < 1e-9, "{width}");

    // An open shell has a finding with its line, and no size.
    let step = include_str!("../../../../examples/plant/cover.step");
    let open = step.replacen("CLOSED_SHELL", "OPEN_SHELL", 1);
    let checked = sources.check(SourceKind::Product, "open.step", open.as_bytes());
    let [found] = checked.findings.as_slice() else {
        panic!("{checked:?}")
    };
    assert!(checked.accepted && found.line.is_some() && found.what.contains("OPEN_SHELL"));
    let is_new = SourceFiles::put(&sources, SourceKind::Product, "open.step", open.as_bytes());
    assert_eq!(is_new, Ok(true));
    assert_eq!(sources.findings().len(), 1);
    let both = query.value(&knowledge).unwrap();
    assert_eq!(both, width, "the product without a size does not count");
    let cut = sources.check(SourceKind::Product, "cut.step", &step.as_bytes()[..900]);
    assert!(!cut.accepted && cut.findings[0].line.is_some(), "{cut:?}");
}
