//! Checks of mappings, explanations of codes, and the schema.

use std::fs;
use std::path::Path;

use serde_json::{Value, json};

use crate::program::{file, run, run_on};

const SHIPPED: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../mappings");

fn shipped(name: &str) -> String {
    Path::new(SHIPPED).join(name).to_str().unwrap().to_owned()
}

const FAULTY: &str =
    "spaces:\n  - id: 1\nvariables:\n  - node: ns=2;i=10\n    name: a\n    orgin: 1\n";

#[test]
fn a_mapping_that_can_run_is_summed_up() {
    let minimal = shipped("minimal.yaml");
    let ended = run(&["check", &minimal]);
    assert_eq!(ended.code, 0, "{}", ended.stdout);
    let last = ended.stdout.lines().last().unwrap();
    assert!(
        last.starts_with(&format!("{minimal} can run: ")),
        "{}",
        ended.stdout
    );
}

#[test]
fn all_faults_of_all_files_are_told_and_end_with_78() {
    let faulty = file("faulty.yaml", FAULTY);
    let ended = run(&["check", &faulty, &shipped("minimal.yaml")]);
    assert_eq!(ended.code, 78);
    for wanted in [
        "error[M003]",
        "did you mean `origin`?",
        "error[M031]",
        "2 errors",
        &format!("--> {faulty}:6:5"),
        &format!("{faulty} cannot run"),
        "minimal.yaml can run",
    ] {
        assert!(
            ended.stdout.contains(wanted),
            "{wanted}\n---\n{}",
            ended.stdout
        );
    }
}

#[test]
fn a_program_gets_the_same_as_json() {
    let ended = run_on(&["check", "--json", "-"], FAULTY.as_bytes());
    assert_eq!(ended.code, 78);
    let [told] = &ended.lines()[..] else {
        panic!("{}", ended.stdout)
    };
    assert_eq!(
        (&told["file"], &told["canRun"]),
        (&json!("<stdin>"), &json!(false))
    );
    let findings = told["findings"].as_array().unwrap();
    let unknown = findings.iter().find(|one| one["code"] == "M003").unwrap();
    assert_eq!(
        (&unknown["severity"], &unknown["line"], &unknown["column"]),
        (&json!("error"), &json!(6), &json!(5))
    );
    assert!(unknown["help"].as_str().unwrap().contains("origin"));
    let minimal = run(&["check", "--json", &shipped("minimal.yaml")]).quiet();
    let minimal: Value = serde_json::from_str(&minimal).unwrap();
    assert_eq!(minimal["canRun"], true);
}

/// A ROS 2 robot of a vendor, with definitions that are on its own host only.
const FOREIGN: &str = "spaces: [{id: 1}, {id: 2}]\nnamespaces: {2: urn:x}\nvariables:\n\
    - {node: ns=2;i=1, name: Arm, origin: 1, ros: [{topic: /arm, type: std_msgs/Bool}, \
    {space: 2, topic: /arm, type: their_msgs/Arm}]}\n";

#[test]
fn each_host_has_its_part_checked() {
    let path = file("foreign.yaml", FOREIGN);
    for (spaces, code, severity, sum) in [
        ("1", 0, "warning[M063]", "can run for space 1: 1 variable"),
        ("0", 0, "warning[M063]", "can run for space 0: 1 variable"),
        (
            "7",
            0,
            "warning[M063]",
            "can run for space 7 (it has no space 7): 1 variable",
        ),
        ("2", 78, "error[M063]", "cannot run for space 2"),
        ("1,2", 78, "error[M063]", "cannot run for the spaces 1, 2"),
    ] {
        let ended = run(&["check", "--for", spaces, &path]);
        assert_eq!(ended.code, code, "{}", ended.stdout);
        for wanted in [severity, sum] {
            assert!(ended.stdout.contains(wanted), "{}", ended.stdout);
        }
    }
    assert_eq!(run(&["check", &path]).code, 78);
    assert_eq!(run(&["check", "--for", "233", &path]).code, 64);
    let told = run(&["check", "--json", "--for", "1", &path]).quiet();
    let told: Value = serde_json::from_str(&told).unwrap();
    assert_eq!((&told["for"], &told["canRun"]), (&json!([1]), &json!(true)));
    let finding = &told["findings"][0];
    assert_eq!(
        (&finding["severity"], &finding["neededBy"]),
        (&json!("warning"), &json!([2]))
    );
}

#[test]
fn each_type_is_told_with_where_it_is_from() {
    let folder = std::env::temp_dir().join(format!("ua-space-types-{}", std::process::id()));
    let package = folder.join("types/robot_msgs/msg");
    fs::create_dir_all(&package).unwrap();
    fs::write(package.join("Arm.msg"), "float64[] joints\n").unwrap();
    fs::write(package.join("Leg.msg"), "float64 knee\nfloat64 9th\n").unwrap();
    let mapping = folder.join("cell.yaml");
    let text = "spaces: [{id: 2}]\nnamespaces: {2: urn:x}\ntype_paths: [types]\nvariables:\n\
        - {node: ns=2;i=1, name: Arm, origin: 0, ros: {space: 2, topic: /arm, type: robot_msgs/Arm, field: joints}}\n\
        - {node: ns=2;i=2, name: Hip, origin: 2, ros: {topic: /hip, type: robot_msgs/Hip}}\n\
        - {node: ns=2;i=3, name: On, origin: 2, ros: {topic: /on, type: std_msgs/Bool}}\n";
    fs::write(&mapping, text).unwrap();
    let ended = run(&["check", "--json", mapping.to_str().unwrap()]);
    fs::remove_dir_all(&folder).unwrap();
    let told: Value = serde_json::from_str(&ended.stdout).unwrap();
    assert_eq!((ended.code, &told["canRun"]), (0, &json!(true)), "{told}");
    let arm = package.join("Arm.msg");
    assert_eq!(
        told["types"],
        json!([
            {"ros": 2, "name": "robot_msgs/Arm", "from": arm.to_str().unwrap()},
            {"ros": 2, "name": "robot_msgs/Hip", "from": "unknown"},
            {"ros": 2, "name": "std_msgs/Bool", "from": "built in"},
        ])
    );
    let findings = told["findings"].as_array().unwrap();
    let of = |code: &str| findings.iter().find(|one| one["code"] == code).unwrap();
    let message = of("M101")["message"].as_str().unwrap();
    assert!(
        message.contains("Leg.msg:2: expected a field name"),
        "{message}"
    );
    let help = of("M063")["help"].as_str().unwrap();
    assert!(
        help.contains("looked in `") && help.contains("types`"),
        "{help}"
    );
}

#[test]
fn a_file_that_is_no_text_or_not_there_is_told_with_74() {
    let bytes = file("binary.yaml", b"spaces: \xff\n");
    for (name, why) in [
        (bytes.as_str(), "not UTF-8 from byte 8"),
        ("/nowhere/cell.yaml", "No such file"),
    ] {
        let ended = run(&["check", name]);
        assert_eq!(ended.code, 74);
        assert!(
            ended.stderr.starts_with(&format!("cannot read {name}")) && ended.stderr.contains(why),
            "{}",
            ended.stderr
        );
    }
}

#[test]
fn a_code_is_explained_with_an_example_in_either_case() {
    let told = run(&["explain", "M014"]).quiet();
    assert_eq!(told, run(&["explain", "m014"]).quiet());
    assert!(told.starts_with("M014: A variable names a space"), "{told}");
    assert!(
        told.contains("| ") && told.contains("origin 3 is not one of the declared spaces"),
        "{told}"
    );
    let ended = run(&["explain", "M999"]);
    assert_eq!((ended.code, ended.stdout.as_str()), (64, ""));
    assert!(ended.stderr.contains("no finding has that code"));
}

#[test]
fn all_codes_are_listed_a_line_each() {
    let listed = run(&["explain"]).quiet();
    let codes: Vec<&str> = listed.lines().map(|line| &line[..4]).collect();
    assert!(codes.is_sorted() && codes.contains(&"M001") && codes.contains(&"M080"));
    for code in codes {
        assert!(run(&["explain", code]).quiet().starts_with(code));
    }
}

#[test]
fn the_schema_is_the_one_that_is_shipped() {
    let told = run(&["schema"]).quiet();
    assert_eq!(told, fs::read_to_string(shipped("schema.json")).unwrap());
}

#[test]
fn the_files_a_mapping_includes_and_the_environment_are_looked_at() {
    let part = file(
        "part.yaml",
        "variables:\n  - {node: ns=2;i=1, name: A, type: Duble, origin: 1}\n",
    );
    let name = Path::new(&part).file_name().unwrap().to_str().unwrap();
    let whole = file(
        "whole.yaml",
        format!(
            "include: [\"{name}\"]\nspaces: [{{id: 1}}]\nnamespaces: {{2: \"${{NO_SUCH:-urn:x:y}}\"}}\n"
        ),
    );
    let ended = run(&["check", &whole]);
    assert_eq!(ended.code, 78);
    let place = format!("--> {part}:2:37");
    assert!(ended.stdout.contains(&place), "{}", ended.stdout);
    assert!(ended.stdout.contains("type: Duble"), "{}", ended.stdout);
    let told: Value = run(&["check", "--json", &whole]).lines()[0].clone();
    assert_eq!(told["findings"][0]["file"], json!(part));
    fs::write(&part, "{}").unwrap();
    assert_eq!(run(&["check", &whole]).code, 0);
}

#[cfg(unix)]
#[test]
fn a_pipe_that_is_named_is_read_as_a_file() {
    let ended = run_on(&["check", "/dev/stdin"], FAULTY.as_bytes());
    assert_eq!(ended.code, 78, "{}", ended.stderr);
    assert!(
        ended.stdout.contains("--> /dev/stdin:6:5"),
        "{}",
        ended.stdout
    );
}

#[cfg(unix)]
#[test]
fn a_password_in_a_file_others_can_read_is_told_and_not_shown() {
    use std::os::unix::fs::PermissionsExt as _;
    let text = "server: {endpoint: \"opc.tcp://robot:sesame@gateway\"}\n";
    let path = file("secret.yaml", text);
    let told = |mode| {
        fs::set_permissions(&path, fs::Permissions::from_mode(mode)).unwrap();
        let ended = run(&["check", &path]);
        assert_eq!(ended.code, 78, "an endpoint has no password");
        let json = run(&["check", "--json", &path]);
        for output in [&ended.stdout, &ended.stderr, &json.stdout] {
            assert!(!output.contains("sesame"), "{output}");
        }
        assert!(ended.stdout.contains("warning[M114]"), "{}", ended.stdout);
        ended.stdout
    };
    assert!(told(0o644).contains("every user of this host can read it"));
    assert!(told(0o640).contains("the group of the file can read it"));
    assert!(!told(0o600).contains("can read it"));
    let ended = run_on(&["check", "-"], text.as_bytes());
    assert!(
        ended.stdout.contains("opc.tcp://robot:******@gateway"),
        "{}",
        ended.stdout
    );
}

/// A NodeSet with a Double variable.
const LINE: &str = r#"<UANodeSet xmlns="http://opcfoundation.org/UA/2011/03/UANodeSet.xsd">
  <NamespaceUris><Uri>urn:line</Uri></NamespaceUris>
  <UAVariable NodeId="ns=1;i=1" BrowseName="1:Speed" DataType="i=11">
    <DisplayName>Speed</DisplayName>
    <References><Reference ReferenceType="i=47" IsForward="false">i=85</Reference></References>
  </UAVariable>
</UANodeSet>"#;

#[test]
fn each_nodeset_that_cannot_be_loaded_is_told_where_it_is_named_and_with_what_to_do() {
    let folder = std::env::temp_dir().join(format!("ua-space-nodesets-{}", std::process::id()));
    fs::create_dir_all(folder.join("folder.xml")).unwrap();
    let write = |name: &str, text: &str| fs::write(folder.join(name), text).unwrap();
    write("line.xml", LINE);
    write("again.xml", LINE);
    let needs = LINE.replace("urn:line", "urn:cell</Uri><Uri>urn:nowhere");
    let needs = needs.replace(">i=85<", ">ns=2;i=85<");
    write("needs.xml", &needs);
    write("core.xml", &LINE.replace("ns=1;i=1", "i=85000"));
    write("text.xml", "spaces: []");
    write("half.xml", &LINE[..LINE.len() - 20]);
    write("other.xml", "<Project/>");
    let large = fs::File::create(folder.join("large.xml")).unwrap();
    large.set_len((64 << 20) + 1).unwrap();
    let mapping = folder.join("cell.yaml");
    let check = |files: &str, spaces: &[&str]| {
        let text = format!(
            "spaces: [{{id: 1}}]\nnamespaces: {{2: 'urn:line'}}\nserver: {{nodesets: [{files}]}}\nvariables:\n\
            \x20 - {{node: ns=2;i=1, name: speed, type: Int32, origin: 1}}\n"
        );
        fs::write(&mapping, text).unwrap();
        let arguments = [&["check", "--json", mapping.to_str().unwrap()], spaces].concat();
        let ended = run(&arguments);
        let told: Value = serde_json::from_str(&ended.stdout).unwrap();
        (ended.code, told["findings"].as_array().unwrap().clone())
    };
    let mut wrong = Vec::new();
    for (file, why, help) in [
        (
            "away.xml",
            "No such file",
            "relative to the folder of the file",
        ),
        (
            "folder.xml",
            "it is not a file",
            "relative to the folder of the file",
        ),
        ("large.xml", "larger than 64 MiB", "UANodeSet"),
        ("text.xml", "is not a NodeSet2 document", "UANodeSet"),
        ("half.xml", "is not a NodeSet2 document", "UANodeSet"),
        ("other.xml", "is not a NodeSet2 document", "UANodeSet"),
        ("core.xml", "nodes of the core namespace", "remove the file"),
        (
            "needs.xml",
            "needs the namespace urn:nowhere",
            "add the NodeSet2 file of this",
        ),
        (
            "line.xml, again.xml",
            "both have nodes of the namespace urn:line",
            "remove one",
        ),
    ] {
        let (code, findings) = check(file, &[]);
        let found = findings.first().unwrap_or(&Value::Null);
        let text = |key: &str| found[key].as_str().unwrap_or_default().to_owned();
        let column = 21 + file.find(", ").map_or(0, |at| at + 2);
        let sound = (code, &found["code"], &found["severity"])
            == (78, &json!("M170"), &json!("error"))
            && (&found["line"], &found["column"]) == (&json!(3), &json!(column))
            && text("message").contains(why)
            && text("help").contains(help);
        if !sound {
            wrong.push(format!("{file}: {code} {findings:?}"));
        }
        // The files may be missing on the host of a bridge.
        let (code, findings) = check(file, &["--for", "1"]);
        if code != 0
            || findings
                .first()
                .is_none_or(|found| found["severity"] != "warning")
        {
            wrong.push(format!("{file} for space 1: {code} {findings:?}"));
        }
    }
    let (code, findings) = check("line.xml", &[]);
    fs::remove_dir_all(&folder).unwrap();
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    assert_eq!((code, &findings[0]["code"]), (78, &json!("M171")));
    assert_eq!(findings[0]["help"], "type: Double");
}
