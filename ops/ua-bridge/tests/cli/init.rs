//! Mappings made from NodeSets, and merged into existing files.

use std::fs;
use std::path::Path;

use mappings::Mapping;
use serde_json::Value;

use crate::program::{file, run};

/// Returns a NodeSet of one namespace with variables of these node ids and names.
fn node_set(variables: &[(&str, &str)]) -> String {
    let variables = variables.iter().map(|(node, name)| {
        format!("<UAVariable NodeId=\"{node}\" BrowseName=\"1:{name}\" DataType=\"i=1\"/>\n")
    });
    let variables: String = variables.collect();
    format!(
        "<UANodeSet><NamespaceUris><Uri>urn:line</Uri></NamespaceUris>\n{variables}</UANodeSet>"
    )
}

fn fresh(name: &str) -> String {
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    if path.exists() {
        fs::remove_file(&path).unwrap();
    }
    path.to_str().unwrap().to_owned()
}

fn topics(text: &str) -> Vec<(String, String)> {
    let checked = Mapping::from_yaml(text, "cell.yaml");
    assert!(checked.findings.is_empty(), "{}", checked.render(text));
    let mapping = checked.mapping.unwrap();
    let variables = mapping.variables().iter();
    variables
        .map(|one| (one.node.to_string(), one.topic.to_string()))
        .collect()
}

#[test]
fn an_alias_once_given_stays_with_its_node() {
    let out = fresh("aliases.yaml");
    let first = file(
        "first.xml",
        node_set(&[("ns=1;s=B", "B"), ("ns=1;i=7", "Seven")]),
    );
    run(&["init", "--nodeset", &first, "-o", &out]).quiet();
    let of = |node: &str| {
        let all = topics(&fs::read_to_string(&out).unwrap());
        let found = all.into_iter().find(|(other, _)| other == node);
        found.map(|(_, topic)| topic)
    };
    assert_eq!(of("ns=2;s=B").unwrap(), "ua_0_2_8");
    // A variable that is earlier in the alphabet gets the next number, even after a higher number
    // was assigned.
    let second = file(
        "second.xml",
        node_set(&[
            ("ns=1;s=A", "A"),
            ("ns=1;s=B", "B"),
            ("ns=1;i=7", "Seven"),
            ("ns=1;i=70000", "Big"),
        ]),
    );
    run(&["init", "--nodeset", &second, "-o", &out, "--merge"]).quiet();
    assert_eq!(of("ns=2;s=B").unwrap(), "ua_0_2_8");
    assert_eq!(of("ns=2;s=A").unwrap(), "ua_0_2_9");
    assert_eq!(of("ns=2;i=70000").unwrap(), "ua_0_2_10");
    let before = fs::read_to_string(&out).unwrap();
    run(&["init", "--nodeset", &second, "-o", &out, "--merge"]).quiet();
    assert_eq!(fs::read_to_string(&out).unwrap(), before);
    // A node with a number that is already an alias cannot be added, and is reported once.
    let third = file("third.xml", node_set(&[("ns=1;i=9", "Nine")]));
    let told = run(&["init", "--nodeset", &third, "-o", &out, "--merge", "--json"]).quiet();
    let told: Value = serde_json::from_str(&told).unwrap();
    assert_eq!(
        (&told["variables"], &told["commentedOut"]),
        (&0.into(), &1.into())
    );
    let before = fs::read_to_string(&out).unwrap();
    assert!(
        before.contains("# M054: `ua_0_2_9` is mapped twice"),
        "{before}"
    );
    run(&["init", "--nodeset", &third, "-o", &out, "--merge"]).quiet();
    assert_eq!(fs::read_to_string(&out).unwrap(), before);
}

#[test]
fn what_a_file_names_is_text_and_nothing_else() {
    let out = fresh("odd.yaml");
    let odd = [
        ("ns=1;s=a: b # c", "a: [b]"),
        ("ns=1;s=&quot;x&quot;\\", "true"),
        ("ns=1;s=L\u{ed}nea \u{b0}C\u{2028}", "- # \u{1f916}"),
        ("ns=1;s=x&#10;server: {}", "{}"),
        ("ns=1;s=' '", "~"),
    ];
    let set = file("odd.xml", node_set(&odd));
    run(&["init", "--nodeset", &set, "-o", &out]).quiet();
    let text = fs::read_to_string(&out).unwrap();
    let nodes: Vec<String> = topics(&text).into_iter().map(|(node, _)| node).collect();
    for node in [
        "ns=2;s=a: b # c",
        "ns=2;s=\"x\"\\",
        "ns=2;s=L\u{ed}nea \u{b0}C\u{2028}",
        "ns=2;s=x\nserver: {}",
        "ns=2;s=' '",
    ] {
        assert!(nodes.iter().any(|one| one == node), "{node:?} in {nodes:?}");
    }
    run(&["init", "--nodeset", &set, "-o", &out]).quiet();
    assert_eq!(fs::read_to_string(&out).unwrap(), text);
}

#[test]
fn a_file_that_is_something_else_stays_as_it_is() {
    let set = file("one.xml", node_set(&[("ns=1;i=7", "Seven")]));
    for (name, content, code, said) in [
        ("poem.yaml", "roses: red\n", 78, "M003"),
        ("bytes.yaml", "\u{0}", 78, "M001"),
        (
            "flow.yaml",
            "variables: [{node: i=85, alias: 1, name: a, origin: 0}]\n",
            78,
            "on lines of their own",
        ),
        (
            "other.yaml",
            "spaces:\n- {id: 1}\n",
            74,
            "1 variable (0 guesses)",
        ),
    ] {
        let out = file(name, content);
        let merge = (code == 78).then_some("--merge");
        let words = ["init", "--nodeset", &set, "-o", &out];
        let words: Vec<&str> = words.into_iter().chain(merge).collect();
        let ended = run(&words);
        assert_eq!(ended.code, code, "{name}: {}", ended.stderr);
        assert!(ended.stderr.contains(said), "{name}: {}", ended.stderr);
        assert_eq!(fs::read_to_string(&out).unwrap(), content);
    }
    let out = file("other.yaml", "spaces:\n- {id: 1}\n");
    run(&["init", "--nodeset", &set, "-o", &out, "--merge"]).quiet();
    let text = fs::read_to_string(&out).unwrap();
    assert!(text.starts_with("spaces:\n- {id: 1}\n"), "{text}");
    assert_eq!(topics(&text).len(), 1);
}

#[test]
fn without_a_file_the_mapping_is_the_output() {
    let set = file("out.xml", node_set(&[("ns=1;i=7", "Seven")]));
    let ended = run(&["init", "--nodeset", &set]);
    assert_eq!(ended.code, 0);
    assert!(
        ended.stderr.starts_with("the mapping: 1 variable"),
        "{}",
        ended.stderr
    );
    assert_eq!(
        topics(&ended.stdout),
        [("ns=2;i=7".to_owned(), "ua_0_2_7".to_owned())]
    );
}

#[test]
fn the_starting_model_becomes_a_mapping_that_has_no_findings() {
    let model = fresh("start.sysml");
    assert_eq!(run(&["new", "sysml", "-o", &model]).code, 0);
    let out = fresh("of-model.yaml");
    let ended = run(&["init", "--model", &model, "-o", &out]);
    assert_eq!(ended.code, 0, "{}", ended.stderr);
    let checked = run(&["check", &out]);
    assert_eq!(checked.code, 0, "{}{}", checked.stdout, checked.stderr);
    assert_eq!(
        topics(&fs::read_to_string(&out).unwrap()),
        [
            ("ns=2;i=10".to_owned(), "ua_1_2_10".to_owned()),
            ("ns=2;i=12".to_owned(), "ua_0_2_12".to_owned())
        ]
    );
    let before = fs::read_to_string(&out).unwrap();
    run(&["init", "--model", &model, "-o", &out, "--merge"]).quiet();
    assert_eq!(fs::read_to_string(&out).unwrap(), before);
}

#[test]
fn a_faulty_model_is_reported_with_its_lines_and_writes_nothing() {
    let model = file(
        "faulty.sysml",
        "part line {\n  attribute a { @Ros1Topic { topik = \"/a\"; } }\n}\n",
    );
    let out = fresh("of-faulty.yaml");
    let ended = run(&["init", "--model", &model, "-o", &out]);
    assert_eq!(ended.code, 65, "{}", ended.stderr);
    for said in [
        ":2: Ros1Topic has no `topik`; did you mean `topic`?",
        ":2: Ros1Topic needs `topic`",
        ":2: Ros1Topic needs `type`",
    ] {
        assert!(ended.stderr.contains(said), "{said} in {}", ended.stderr);
    }
    assert!(!Path::new(&out).exists());
}
