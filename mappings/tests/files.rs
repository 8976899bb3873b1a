//! Documents of several files, with environment variables and with anchors and aliases of YAML.
use std::collections::BTreeMap;

use mappings::{Checked, Code, FileReaders, Mapping, Surroundings};

/// Files and variables, by name.
#[derive(Default)]
struct Beside {
    files: BTreeMap<String, String>,
    variables: BTreeMap<String, String>,
    readers: Option<FileReaders>,
}

impl Beside {
    fn file(mut self, name: &str, text: &str) -> Self {
        self.files.insert(name.to_owned(), text.to_owned());
        self
    }

    fn set(mut self, name: &str, value: &str) -> Self {
        self.variables.insert(name.to_owned(), value.to_owned());
        self
    }

    fn check(&self, text: &str) -> Checked {
        Mapping::from_text(text, "plant/cell.yaml", self)
    }
}

impl Surroundings for Beside {
    fn read(&self, file: &str) -> std::io::Result<String> {
        let text = self.files.get(file).cloned();
        text.ok_or_else(|| std::io::Error::other("there is no such file"))
    }

    fn list(&self, folder: &str) -> std::io::Result<Vec<String>> {
        let names = self.files.keys().filter_map(|file| file.rsplit_once('/'));
        let within = names.filter(|(of, _)| *of == folder);
        Ok(within.map(|(_, name)| name.to_owned()).rev().collect())
    }

    fn variable(&self, name: &str) -> Option<String> {
        self.variables.get(name).cloned()
    }

    fn readers(&self, file: &str) -> Option<FileReaders> {
        self.readers.filter(|_| file == "plant/cameras.yaml")
    }
}

const HEAD: &str = "spaces: [{id: 1}]\nnamespaces: {2: urn:my-plant:line}\n";

fn variable(id: u16, name: &str) -> String {
    format!("  - {{node: ns=2;i={id}, name: {name}, type: Double, origin: 1}}\n")
}

#[test]
fn the_history_is_beside_the_file_that_names_it() {
    let file = |text: &str| {
        let part = "server: {history: {file: data/history.redb}}\n";
        let beside = Beside::default().file("plant/servers/one.yaml", part);
        let checked = beside.check(text);
        let mapping = checked.mapping.expect("a mapping without errors");
        mapping.server().history_file.clone().unwrap()
    };
    let own = format!("{HEAD}server: {{history: {{file: history.redb}}}}\n");
    assert_eq!(file(&own).to_str(), Some("plant/history.redb"));
    let included = format!("include: servers/one.yaml\n{HEAD}");
    let wanted = Some("plant/servers/data/history.redb");
    assert_eq!(file(&included).to_str(), wanted);
    let absolute = format!("{HEAD}server: {{history: {{file: /var/lib/history.redb}}}}\n");
    assert_eq!(file(&absolute).to_str(), Some("/var/lib/history.redb"));
}

fn names(checked: &Checked) -> Vec<&str> {
    let mapping = checked.mapping.as_ref().unwrap();
    let names = mapping.variables().iter().map(|v| v.name.as_str());
    names.collect()
}

/// Returns one line per finding: code, file and line, and the label.
fn told(checked: &Checked) -> Vec<String> {
    let findings = checked.findings.iter().map(|found| {
        let label = found.label.clone().unwrap_or_default();
        format!("{} {}:{} {label}", found.code, found.at.file, found.at.line)
            .trim()
            .to_owned()
    });
    findings.collect()
}

#[test]
fn the_files_of_a_document_are_as_one() {
    let beside = Beside::default()
        .file(
            "plant/robots/b.yaml",
            &format!("variables:\n{}", variable(2, "B")),
        )
        .file(
            "plant/robots/a.yaml",
            &format!("variables:\n{}", variable(1, "A")),
        )
        .file("plant/robots/.b.yaml.swp", "not YAML: [")
        .file("shared/net.yaml", "include: ports.yaml\npubsub: {ttl: 4}\n")
        .file(
            "shared/ports.yaml",
            "server: {endpoint: 'opc.tcp://gateway:4841'}\n",
        );
    let text = format!(
        "include: [robots/*.yaml, ../shared/net.yaml]\n{HEAD}variables:\n{}",
        variable(9, "Own")
    );
    let checked = beside.check(&text);
    assert_eq!(checked.render_all(), "");
    assert_eq!(names(&checked), ["Own", "A", "B"]);
    let mapping = checked.mapping.as_ref().unwrap();
    assert_eq!(mapping.pubsub().ttl, 4);
    assert_eq!(mapping.server().endpoint.host, "gateway");
    let sources: Vec<&str> = checked.sources.iter().map(|source| &*source.name).collect();
    let files = ["robots/a.yaml", "robots/b.yaml"].map(|name| format!("plant/{name}"));
    assert_eq!(
        sources,
        [
            "plant/cell.yaml",
            &files[0],
            &files[1],
            "shared/net.yaml",
            "shared/ports.yaml"
        ]
    );
}

#[test]
fn a_finding_is_told_with_its_own_file_and_what_it_collides_with() {
    let beside = Beside::default().file(
        "plant/more.yaml",
        &format!(
            "{HEAD}pubsub: {{}}\nvariables:\n{}  - {{nod: 1}}\n",
            variable(1, "B")
        ),
    );
    let checked = beside.check(&format!(
        "include: more.yaml\n{HEAD}pubsub: {{}}\nvariables:\n{}",
        variable(1, "A")
    ));
    assert!(checked.mapping.is_none());
    assert_eq!(
        told(&checked),
        [
            "M011 plant/more.yaml:1 first at line 2 of plant/cell.yaml",
            "M030 plant/more.yaml:2 first at line 3 of plant/cell.yaml",
            "M030 plant/more.yaml:2 first at line 3 of plant/cell.yaml",
            "M004 plant/more.yaml:3 first at line 4 of plant/cell.yaml",
            "M053 plant/more.yaml:5 first at line 6 of plant/cell.yaml",
            "M006 plant/more.yaml:6",
            "M006 plant/more.yaml:6",
            "M003 plant/more.yaml:6",
            "M050 plant/more.yaml:6",
        ]
    );
    let rendered = checked.render_all();
    assert!(
        rendered.contains("6 |   - {nod: 1}\n  |      ^^^"),
        "{rendered}"
    );
}

#[test]
fn includes_that_lead_nowhere_or_in_circles_are_named() {
    let beside = Beside::default()
        .file("plant/a.yaml", "include: b.yaml\n")
        .file("plant/b.yaml", "include: [a.yaml, cell.yaml]\n")
        .file("plant/broken.yaml", "variables: [\n");
    let checked = beside.check(
        "include: [a.yaml, ./b.yaml, none.yaml, broken.yaml, no/*.yaml]\nvariables:\n  - \
         {node: ns=2;i=1, name: A, type: Double, origin: 1}\n",
    );
    // No finding concerns the space and the namespace, which may be declared in the missing file.
    assert_eq!(
        told(&checked),
        [
            "M111 plant/cell.yaml:1 first at line 1 of plant/a.yaml",
            "M110 plant/cell.yaml:1",
            "M110 plant/cell.yaml:1",
            "M111 plant/b.yaml:1",
            "M111 plant/b.yaml:1",
            "M001 plant/broken.yaml:1",
        ]
    );
    let circle = &checked.findings[3].message;
    assert!(
        circle.ends_with("plant/cell.yaml -> plant/a.yaml -> plant/b.yaml -> plant/a.yaml"),
        "{circle}"
    );
    let deep = (0..20).fold(Beside::default(), |beside, n| {
        beside.file(
            &format!("plant/{n}.yaml"),
            &format!("include: {}.yaml\n", n + 1),
        )
    });
    let checked = deep.check("include: 0.yaml\n");
    assert_eq!(told(&checked), ["M111 plant/7.yaml:1"]);
}

#[test]
fn variables_of_the_environment_stand_for_their_values() {
    let text = format!(
        "{HEAD}pubsub: {{address: \"opc.udp://${{GROUP:-239.192.0.40}}:4840\", ttl: \"${{TTL}}\"}}\nvariables:\n  - node: ns=2;i=${{ID}}\n    \
         name: \"$${{ID}}\"\n    type: Double\n    origin: 1\n"
    );
    let beside = Beside::default().set("TTL", "3").set("ID", "17");
    let checked = beside.check(&text);
    assert_eq!(checked.render_all(), "");
    let mapping = checked.mapping.as_ref().unwrap();
    assert_eq!(mapping.pubsub().ttl, 3);
    assert_eq!(mapping.variables()[0].topic.to_string(), "ua_1_2_17");
    assert_eq!(names(&checked), ["${ID}"]);

    let checked = Beside::default().set("ID", "17").check(&text);
    assert_eq!(told(&checked), ["M112 plant/cell.yaml:3"]);
    assert!(checked.render_all().contains("`TTL` is not set"));
}

#[test]
fn what_the_environment_says_is_not_told() {
    let secret = "hunter2-hunter2";
    let text = format!(
        "{HEAD}pubsub: {{interface: \"${{KEY}}x y\"}}\nvariables:\n  - node: ns=2;i=${{KEY}}\n    name: A\n    type: ${{KEY}}\n    origin: ${{NUMBER}}\n"
    );
    let beside = Beside::default().set("KEY", secret).set("NUMBER", "300");
    let checked = beside.check(&text);
    let rendered = checked.render_all();
    assert!(checked.findings.len() >= 4, "{rendered}");
    assert!(
        !rendered.contains("hunter2") && !rendered.contains("`300`"),
        "{rendered}"
    );
    assert!(rendered.contains("`${KEY}`"), "{rendered}");
}

#[test]
fn the_beginning_of_a_value_that_is_cut_is_not_told() {
    let secret = "hunter2-".repeat(6);
    let text = format!(
        "{HEAD}variables:\n  - node: \"a node whose id is written in many words: ${{KEY}}\"\n    name: A\n    type: Double\n    origin: 1\n"
    );
    let checked = Beside::default().set("KEY", &secret).check(&text);
    let rendered = checked.render_all();
    assert!(rendered.contains("${KEY}..."), "{rendered}");
    assert!(!rendered.contains("hunter2"), "{rendered}");
}

#[test]
fn values_of_the_environment_have_no_more_bytes_than_they_may() {
    let value = "x".repeat(60_000);
    let beside = Beside::default().set("LONG", &value);
    let many = |times: usize| format!("a: [{}]\n", "\"${LONG}\", ".repeat(times));
    let checked = beside.check(&many(100));
    let codes: Vec<Code> = checked.findings.iter().map(|one| one.code).collect();
    assert_eq!(codes, [Code::TooLarge], "{}", checked.render_all());
    let checked = beside.check(&many(10));
    let mut codes = checked.findings.iter().map(|one| one.code);
    assert!(!codes.any(|code| code == Code::TooLarge));
    // The values of all files count together.
    let halves = ["a", "b"].into_iter().fold(Beside::default(), |all, name| {
        all.file(&format!("plant/{name}.yaml"), &many(40))
    });
    let checked = halves
        .set("LONG", &value)
        .check("include: [a.yaml, b.yaml]\n");
    let codes: Vec<Code> = checked.findings.iter().map(|one| one.code).collect();
    assert!(codes.contains(&Code::TooLarge), "{}", checked.render_all());
}

#[test]
fn anchors_aliases_and_merge_keys_share_what_they_name() {
    let text = format!(
        "{HEAD}variables:\n  - &joint\n    node: ns=2;i=1\n    name: A\n    type: Double\n    origin: 1\n    queue: &events \
         {{drop_oldest: 7}}\n  - <<: *joint\n    node: ns=2;i=2\n    name: B\n  - {{<<: [*joint], node: ns=2;i=3, \
         name: C, type: Int16, queue: *events}}\n"
    );
    let checked = Beside::default().check(&text);
    assert_eq!(checked.render_all(), "");
    let variables = checked.mapping.as_ref().unwrap().variables();
    assert_eq!(names(&checked), ["A", "B", "C"]);
    assert_eq!(variables[1].value_type, variables[0].value_type);
    assert_ne!(variables[2].value_type, variables[0].value_type);
    assert_eq!(variables[1].overflow, variables[0].overflow);

    // A fault of a shared node is reported once, at its own position.
    let faulty = text.replace("origin: 1\n", "origin: 3\n");
    assert_eq!(
        told(&Beside::default().check(&faulty)),
        ["M014 plant/cell.yaml:8"]
    );
}

#[test]
fn merge_keys_upon_merge_keys_are_bounded() {
    let mut text = "x0: &x0 {".to_owned();
    for key in 0..2000 {
        text += &format!("k{key}: 1, ");
    }
    text += "}\n";
    for n in 1..400 {
        let below = n - 1;
        text += &format!("x{n}: &x{n} {{<<: *x{below}, own{n}: 1}}\n");
    }
    let checked = Beside::default().check(&text);
    assert_eq!(checked.findings.len(), 1, "{}", checked.render_all());
    assert_eq!(checked.findings[0].code, Code::TooLarge);
}

#[test]
fn a_map_that_is_merged_again_and_again_counts_each_time() {
    let keys: String = (0..1000).map(|key| format!("k{key}: 1, ")).collect();
    let again = "*x, ".repeat(2600);
    let checked = Beside::default().check(&format!("x: &x {{{keys}}}\ny: {{<<: [{again}]}}\n"));
    assert_eq!(checked.findings.len(), 1, "{}", checked.render_all());
    assert_eq!(checked.findings[0].code, Code::TooLarge);
    assert_eq!(checked.findings[0].at.line, 2);
}

#[test]
fn a_password_in_a_file_is_told_with_who_can_read_it_and_never_shown() {
    let url = "rtsp://robot:open-sesame@camera/hall";
    let cameras = |url: &str| {
        format!(
            "variables:\n  - {{node: ns=2;i=1, name: A, origin: 0, ros: {{space: 1, call: /look, type: nav_msgs/LoadMap, \
             request: {{map_url: \"{url}\"}}}}}}\n"
        )
    };
    let mut beside = Beside::default()
        .set("SECRET", "open-sesame")
        .file("plant/cameras.yaml", &cameras(url));
    let text = format!("include: cameras.yaml\n{HEAD}");
    for (readers, label, help) in [
        (
            None,
            "",
            "write ${NAME}, and set this environment variable for the program",
        ),
        (
            Some(FileReaders::Group),
            " the group of the file can read it",
            "chmod g-r plant/cameras.yaml",
        ),
        (
            Some(FileReaders::Everybody),
            " every user of this host can read it",
            "chmod go-r plant/cameras.yaml",
        ),
    ] {
        beside.readers = readers;
        let checked = beside.check(&text);
        assert!(checked.mapping.is_some(), "it can run");
        assert_eq!(
            told(&checked),
            [format!("M114 plant/cameras.yaml:2{label}")]
        );
        let said = checked.findings[0].help.as_deref().unwrap();
        assert!(said.ends_with(help), "{said}");
        let shown = checked.render_all();
        assert!(!shown.contains("sesame"), "{shown}");
        assert!(
            shown.contains("rtsp://robot:***********@camera/hall"),
            "{shown}"
        );
    }
    let apart = "rtsp://robot:${SECRET}@camera/hall";
    let beside = beside.file("plant/cameras.yaml", &cameras(apart));
    assert_eq!(told(&beside.check(&text)), [""; 0]);
    // Nor is the password shown if a long text is cut, or if another finding shows the text.
    let long = format!("opc.tcp://robot:{}@gateway", "open-sesame".repeat(8));
    let text = format!("{HEAD}server: {{endpoint: \"{long}\"}}\n");
    let checked = beside.check(&text);
    let shown = checked.render(&text);
    assert!(
        shown.contains("M040") && !shown.contains("sesame"),
        "{shown}"
    );
    let text = format!("{HEAD}server: {{endpoint: [\"{long}\"]}}\nbroken: [\"{url}\"");
    let checked = beside.check(&text);
    let shown = checked.render(&text);
    assert!(
        !shown.contains("sesame") && !checked.findings.is_empty(),
        "{shown}"
    );
}

#[test]
fn the_passwords_of_a_file_are_one_finding_and_leave_room_for_errors() {
    let url = |n: usize| format!("  - \"http://robot:open-sesame-{n}@host\"\n");
    let urls: String = (0..300).map(url).collect();
    let text = format!("{HEAD}servr:\n{urls}");
    let checked = Beside::default().check(&text);
    let of_secrets: Vec<_> = checked
        .findings
        .iter()
        .filter(|found| found.code == Code::Secret)
        .collect();
    let [found] = of_secrets[..] else {
        panic!("{}", checked.render(&text));
    };
    assert!(
        found.at.line == 4 && found.message.ends_with(", and 299 more in this file"),
        "{found}"
    );
    let shown = checked.render(&text);
    assert!(
        shown.contains("servr") && !shown.contains("sesame"),
        "{shown}"
    );
}

#[test]
fn a_url_is_no_path_and_its_password_is_not_shown() {
    let url = "https://robot:open-sesame@host/x.yaml";
    for (keys, code) in [
        ("include: [@]", Code::Include),
        ("type_paths: [@]", Code::TypePath),
        ("server: {nodesets: [@]}", Code::NodeSet),
    ] {
        let text = format!("{HEAD}{}\n", keys.replace('@', &format!("\"{url}\"")));
        let wild = text.replace("x.yaml", "*.yaml");
        let given = text.replace(url, "${URL}");
        for text in [text, wild, given] {
            let checked = Beside::default().set("URL", url).check(&text);
            let mut codes = checked.findings.iter().map(|found| found.code);
            assert!(codes.any(|found| found == code), "{text}");
            let shown = checked.render(&text);
            assert!(
                shown.contains("expected the path of a file, found a URL")
                    && !shown.contains("sesame"),
                "{shown}"
            );
        }
    }
}

#[test]
fn a_long_value_of_the_environment_is_not_told_as_a_constant() {
    let text = format!(
        "{HEAD}variables:\n  - {{node: ns=2;i=1, name: A, origin: 1, ros: {{poll: /b, type: nav_msgs/GetPlan, \
         request: {{tolerance: \"${{TOKEN}}\"}}, field: plan.poses}}}}\n"
    );
    let checked = Beside::default()
        .set("TOKEN", &"open-sesame".repeat(8))
        .check(&text);
    let shown = checked.render(&text);
    assert!(
        shown.contains("`${TOKEN}` is not a number") && !shown.contains("sesame"),
        "{shown}"
    );
}
