//! One faulty document per code in tests/bad/, and beside it what people are told about it.
#![expect(clippy::unwrap_used, reason = "test code")]

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use mappings::{
    Checked, Code, Environment, LiveNode, LiveServer, LiveSpace, LiveTopic, Mapping, Severity,
    SpaceId,
};
use uadp::BuiltinType;

fn documents() -> Vec<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/bad");
    let entries = std::fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path());
    let mut found: Vec<PathBuf> = entries
        .filter(|path| path.extension().is_some_and(|e| e == "yaml"))
        .collect();
    found.sort();
    found
}

fn check(path: &Path) -> (String, Checked) {
    let text = std::fs::read_to_string(path).unwrap();
    let name = path.file_name().unwrap().to_string_lossy();
    let checked = if name.starts_with("M12") {
        Mapping::from_yaml_in(&text, &name, &environment())
    } else {
        Mapping::from_yaml(&text, &name)
    };
    (text, checked)
}

/// What is there for the documents that name what is not.
fn environment() -> Environment {
    let topic = |kind: &str, published| LiveTopic {
        types: BTreeSet::from([kind.to_owned()]),
        published,
        subscribed: !published,
    };
    let ros1 = LiveSpace {
        topics: BTreeMap::from([
            ("/conveyor/running".to_owned(), topic("std_msgs/Bool", true)),
            ("/conveyor/switch".to_owned(), topic("std_msgs/Bool", false)),
            ("/robot1/pose".to_owned(), topic("std_msgs/String", true)),
        ]),
        services: Some(BTreeSet::from(["/conveyor/start".to_owned()])),
    };
    Environment {
        spaces: BTreeMap::from([(SpaceId::ROS1, ros1)]),
        server: Some(LiveServer {
            namespaces: ["http://opcfoundation.org/UA/", "urn:server", "urn:line"]
                .map(str::to_owned)
                .to_vec(),
            nodes: BTreeMap::from([
                ("ns=2;i=98".to_owned(), LiveNode::Away),
                (
                    "ns=2;i=99".to_owned(),
                    LiveNode::Variable(Some((BuiltinType::Double, false))),
                ),
            ]),
        }),
    }
}

#[test]
fn what_was_not_asked_for_is_not_missed() {
    for path in documents() {
        let text = std::fs::read_to_string(&path).unwrap();
        let name = path.file_name().unwrap().to_string_lossy();
        if name.starts_with("M12") {
            let checked = Mapping::from_yaml_in(&text, &name, &Environment::default());
            assert!(checked.findings.is_empty(), "{}", checked.render(&text));
        }
    }
}

#[test]
fn each_faulty_document_is_told_as_its_snapshot_has_it() {
    let refresh = std::env::var_os("UA_REFRESH").is_some();
    let mut differ = Vec::new();
    for path in documents() {
        let (text, checked) = check(&path);
        let told = checked.render(&text);
        let snapshot = path.with_extension("txt");
        if refresh {
            std::fs::write(&snapshot, &told).unwrap();
        }
        let expected = std::fs::read_to_string(&snapshot).unwrap_or_default();
        if told != expected {
            differ.push(format!(
                "{}\n--- expected\n{expected}--- told\n{told}",
                path.display()
            ));
        }
    }
    let refresh = "if they are better than before: UA_REFRESH=1 cargo test -p mappings";
    assert!(differ.is_empty(), "{}\n{refresh}", differ.join("\n"));
}

#[test]
fn a_document_named_after_a_code_has_that_code_and_no_other() {
    for path in documents() {
        let stem = path.file_stem().unwrap().to_string_lossy().into_owned();
        let Ok(code) = stem.split('-').next().unwrap_or_default().parse::<Code>() else {
            continue;
        };
        let (text, checked) = check(&path);
        let codes: BTreeSet<Code> = checked.findings.iter().map(|found| found.code).collect();
        assert_eq!(
            codes,
            BTreeSet::from([code]),
            "{stem}:\n{}",
            checked.render(&text)
        );
        let errors = checked
            .findings
            .iter()
            .any(|found| found.severity == Severity::Error);
        assert_eq!(checked.mapping.is_none(), errors, "{stem}");
    }
}

#[test]
fn every_code_has_a_faulty_document() {
    let documents = documents();
    for code in Code::ALL {
        let named = |path: &PathBuf| {
            path.file_stem()
                .is_some_and(|stem| stem.to_string_lossy().starts_with(code.as_str()))
        };
        assert!(
            documents.iter().any(named),
            "tests/bad/{code}.yaml is missing"
        );
    }
}

#[test]
fn ten_faults_are_ten_findings_of_one_run() {
    let path = documents()
        .into_iter()
        .find(|path| path.ends_with("ten-faults.yaml"))
        .unwrap();
    let (text, checked) = check(&path);
    assert_eq!(checked.findings.len(), 10, "{}", checked.render(&text));
    let places: BTreeSet<usize> = checked.findings.iter().map(|found| found.at.line).collect();
    assert_eq!(places.len(), 10, "each on a line of its own");
    assert!(checked.mapping.is_none());
    assert!(checked.findings.is_sorted_by_key(|found| found.at.line));
}
