//! One faulty document per code in tests/bad/, with the expected findings beside it.
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use mappings::{
    Access, Checked, Code, Endpoint, Environment, Identifier, LiveNode, LiveRemote, LiveServer,
    LiveSpace, LiveTopic, Mapping, MethodTarget, NodeSetFault, NodeSetNode, NodeSetType, NodeSets,
    OpenTypeFiles, PathFault, PathFaultKind, Severity, SpaceId, Surroundings, TypeOrigin,
};
use messages::{DefinitionText, DefinitionTexts, Dialect, Language, TextKind, TypeName};
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
    let around = Around {
        environment: name.starts_with("M12").then(environment),
    };
    (text.clone(), Mapping::from_text(&text, &name, &around))
}

/// Definitions in the folder `types`, and optionally a running cell.
#[derive(Default)]
struct Around {
    environment: Option<Environment>,
}

impl Surroundings for Around {
    fn read(&self, file: &str) -> std::io::Result<String> {
        Err(std::io::Error::other(format!("{file} is not there")))
    }

    fn list(&self, folder: &str) -> std::io::Result<Vec<String>> {
        self.read(folder).map(|_| Vec::new())
    }

    fn variable(&self, name: &str) -> Option<String> {
        (name == "PLC_PASSWORD").then(|| "correct horse".to_owned())
    }

    fn types(&self, paths: &[PathBuf]) -> Box<dyn OpenTypeFiles> {
        Box::new(Folder(paths.to_vec()))
    }

    fn nodesets(&self, files: &[PathBuf]) -> Option<Box<dyn NodeSets>> {
        Some(Box::new(LineNodeSet(files.to_vec())))
    }

    fn environment(&self) -> Option<&Environment> {
        self.environment.as_ref()
    }
}

/// The NodeSet of a line, in the file line.xml; there is no other file.
struct LineNodeSet(Vec<PathBuf>);

impl NodeSets for LineNodeSet {
    fn faults(&mut self) -> Vec<NodeSetFault> {
        let files = self.0.iter().enumerate();
        files
            .filter(|(_, path)| !path.ends_with("line.xml"))
            .map(|(file, path)| NodeSetFault {
                file,
                is_fatal: true,
                what: format!(
                    "the NodeSet {} cannot be read: it is not there",
                    path.display()
                ),
                help: "the path is relative to the folder of the file that contains it".to_owned(),
            })
            .collect()
    }

    fn fingerprint(&self) -> u64 {
        0
    }

    fn has(&self, uri: &str) -> bool {
        uri == "urn:line"
    }

    fn node(&self, _: &str, node: &Identifier) -> Option<NodeSetNode> {
        let Identifier::Numeric(number) = node else {
            return None;
        };
        Some(match number {
            1 => NodeSetNode::Variable(NodeSetType::Builtin(BuiltinType::Double), -1),
            2 => NodeSetNode::Variable(NodeSetType::Number, -1),
            3 => NodeSetNode::Variable(NodeSetType::Builtin(BuiltinType::Int32), 1),
            4 => NodeSetNode::Other,
            5 => NodeSetNode::Method,
            1001 => NodeSetNode::Variable(NodeSetType::Any, -2),
            1002 => NodeSetNode::Variable(NodeSetType::Any, -1),
            _ => return None,
        })
    }
}

/// The folder `types`, under any path that a document names; there is no other folder.
struct Folder(Vec<PathBuf>);

impl DefinitionTexts for Folder {
    fn find(&mut self, _: Dialect, kind: TextKind, name: &TypeName) -> Option<DefinitionText> {
        let text = match (kind, name.as_str()) {
            (TextKind::Message, "std_msgs/Bool") => "bool data\nuint8 quality\n",
            (TextKind::Message, "robot_msgs/Arm") => "float64[] joints\n",
            _ => return None,
        };
        self.0.first().map(|path| DefinitionText {
            text: text.to_owned(),
            language: Language::Ros,
            file: format!("{}/{}.msg", path.display(), name.name()).into(),
        })
    }

    fn names(&mut self, _: Dialect, kind: TextKind) -> Vec<TypeName> {
        let known = !self.0.is_empty() && kind == TextKind::Message;
        known
            .then(|| "robot_msgs/Arm".parse().unwrap())
            .into_iter()
            .collect()
    }

    fn places(&self, _: Dialect) -> Vec<String> {
        self.0
            .iter()
            .map(|path| path.display().to_string())
            .collect()
    }
}

impl OpenTypeFiles for Folder {
    fn faults(&mut self) -> Vec<PathFault> {
        let fault = |(path, place): (usize, &PathBuf)| {
            let what = match place.to_str() {
                Some("types") => return None,
                Some("broken") => {
                    PathFaultKind::File("broken/msg/Leg.msg:3: a field name expected".to_owned())
                }
                _ => {
                    PathFaultKind::Empty(format!("{}: no such file or directory", place.display()))
                }
            };
            Some(PathFault { path, what })
        };
        self.0.iter().enumerate().filter_map(fault).collect()
    }
}

/// Returns the running cell for the documents that name missing objects.
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
            (
                "/drive/feedback".to_owned(),
                topic("move_base_msgs/MoveBaseActionFeedback", true),
            ),
        ]),
        services: Some(BTreeMap::from([(
            "/conveyor/start".to_owned(),
            BTreeSet::from(["std_srvs/Trigger".to_owned()]),
        )])),
    };
    let method = |method: &str| MethodTarget {
        access: Access::anonymous(Endpoint {
            host: "192.168.0.10".to_owned(),
            port: 4840,
            path: String::new(),
        }),
        server: None,
        object: "nsu=urn:plc;s=Line".parse().unwrap(),
        method: method.parse().unwrap(),
    };
    let remote = |node: &str, live| (("plc".to_owned(), node.to_owned()), live);
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
        methods: vec![
            (
                method("nsu=urn:plc;s=Line.Rest"),
                Some("the server has no Method `nsu=urn:plc;s=Line.Rest`".to_owned()),
            ),
            (method("nsu=urn:plc;s=Line.Stop"), None),
        ],
        remote: BTreeMap::from([
            remote("nsu=urn:plc;s=Sped", LiveRemote::Away),
            remote(
                "nsu=urn:plc;s=Setpoint",
                LiveRemote::Variable {
                    value: Some((BuiltinType::Double, false)),
                    readable: true,
                    writable: false,
                },
            ),
        ]),
    }
}

#[test]
fn a_type_of_a_file_is_as_good_as_one_that_is_built_in() {
    let text = "spaces: [{id: 1}]\nnamespaces: {2: urn:x}\ntype_paths: [types]\nvariables:\n\
        - {node: ns=2;i=1, name: Arm, origin: 1, ros: {topic: /arm, type: robot_msgs/Arm, field: joints}}\n\
        - {node: ns=2;i=2, name: B, origin: 1, ros: {topic: /b, type: std_msgs/Int8}}\n";
    let checked = Mapping::from_text(text, "cells/one.yaml", &Around::default());
    let mapping = checked.mapping.unwrap();
    assert_eq!(mapping.type_paths(), [PathBuf::from("cells/types")]);
    let arm = mapping.variable("ua_1_2_1".parse().unwrap()).unwrap();
    assert_eq!(arm.value_type, Some((BuiltinType::Double, true)));
    let used: Vec<_> = checked
        .types
        .iter()
        .map(|used| (used.name.as_str(), used.source.clone()))
        .collect();
    assert_eq!(
        used,
        [
            (
                "robot_msgs/Arm",
                TypeOrigin::File("cells/types/Arm.msg".to_owned())
            ),
            ("std_msgs/Int8", TypeOrigin::BuiltIn)
        ]
    );
}

#[test]
fn what_was_not_asked_for_is_not_missed() {
    let nothing = Around {
        environment: Some(Environment::default()),
    };
    for path in documents() {
        let text = std::fs::read_to_string(&path).unwrap();
        let name = path.file_name().unwrap().to_string_lossy();
        if name.starts_with("M12") {
            let checked = Mapping::from_text(&text, &name, &nothing);
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
