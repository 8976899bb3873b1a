//! Mappings of this project: joins, errors and limits.
#![expect(clippy::unwrap_used, reason = "a test may")]

use std::collections::BTreeSet;
use std::path::PathBuf;
use std::{fs, process};

use rml::{Files, Folder, MappingFault, MappingFileFault, RmlMapping, RunOutput};

/// One text for all files.
struct Text(String);

impl Files for Text {
    fn read(&mut self, _: &str) -> Result<Vec<u8>, MappingFileFault> {
        Ok(self.0.clone().into_bytes())
    }
}

const OLD: &str = "@prefix rr: <http://www.w3.org/ns/r2rml#> . @prefix rml: <http://semweb.mmlab.be/ns/rml#> . @prefix ql: <http://semweb.mmlab.be/ns/ql#> . @prefix ex: <http://example.org/> . @base <http://example.org/> .\n";

/// Returns a mapping of the rows of an iterator with one predicate-object map.
fn mapping(iterator: &str, subject: &str, object: &str) -> String {
    format!(
        "{OLD}<#M> rml:logicalSource [ rml:source \"a.xml\"; rml:referenceFormulation ql:XPath; rml:iterator \"{iterator}\" ];
        rr:subjectMap [ rr:template \"http://example.org/{subject}\" ];
        rr:predicateObjectMap [ rr:predicate ex:p; rr:objectMap [ {object} ] ] ."
    )
}

fn run(mapping: &str, xml: &str) -> Result<RunOutput, MappingFault> {
    RmlMapping::read(mapping)?.run(&mut Text(xml.to_owned()))
}

/// Returns the values of `ex:p`, in order.
fn values(mapping: &str, xml: &str) -> Vec<String> {
    let output = run(mapping, xml).unwrap();
    output
        .quads
        .iter()
        .filter_map(|quad| match &quad.object {
            oxrdf::Term::Literal(literal) => Some(literal.value().to_owned()),
            oxrdf::Term::NamedNode(_) | oxrdf::Term::BlankNode(_) => None,
        })
        .collect()
}

const PLANT: &str = r#"<c:Plant xmlns:c="urn:c">
  <c:Unit ID="u1" Name="Mixer"><c:Attribute Name="RefID"><c:Value>d2</c:Value></c:Attribute></c:Unit>
  <c:Unit ID="u2" Name="Pump"><c:Attribute Name="RefID"><c:Value>d1</c:Value></c:Attribute><c:Note>slow &amp; old</c:Note></c:Unit>
  <c:Data ID="d1" Value="4"/>
  <c:Data ID="d2" Value="7"/>
  <c:Data ID="d3" Value="9"/>
</c:Plant>"#;

#[test]
fn current_joins_a_path_with_the_row() {
    let join = "//Data[@ID=current()/Attribute[@Name='RefID']/Value]/@Value";
    let text = mapping(
        "/Plant/Unit",
        "{@Name}",
        &format!("rml:reference \"{join}\""),
    );
    assert_eq!(values(&text, PLANT), ["7", "4"]);
    let reversed = "//Data[current()/Attribute/Value = @ID and @Value > 5]/@Value";
    let text = mapping(
        "/Plant/Unit",
        "{@Name}",
        &format!("rml:reference \"{reversed}\""),
    );
    assert_eq!(values(&text, PLANT), ["7"]);
}

#[test]
fn expressions_have_the_values_of_xpath() {
    for (reference, expected) in [
        ("../Data[last()]/@ID", vec!["d3"]),
        ("../Data[2]/@ID", vec!["d2"]),
        ("(../Data)[position() > 1]/@ID", vec!["d2", "d3"]),
        ("//*[@ID][2]/@ID", vec!["u2"]),
        ("count(../Data)", vec!["3"]),
        ("sum(../Data/@Value) div 8", vec!["2.5"]),
        ("concat(@Name, '-', substring(@ID, 2, 1))", vec!["Pump-2"]),
        ("normalize-space(Note)", vec!["slow & old"]),
        ("translate(@Name, 'Pm', 'L')", vec!["Lup"]),
        ("substring-before(Note, ' ')", vec!["slow"]),
        ("ancestor::*/Data[@ID != 'd1']/@ID", vec!["d2", "d3"]),
        ("following-sibling::Data[1]/@ID", vec!["d1"]),
        ("preceding-sibling::*[1]/@ID", vec!["u1"]),
        ("../Data/@ID | @ID", vec!["u2", "d1", "d2", "d3"]),
        ("local-name()", vec!["Unit"]),
        ("name(..)", vec!["c:Plant"]),
        ("c:Note/text()", vec!["slow & old"]),
        ("not(Missing) or false()", vec!["true"]),
        ("../Data[@Value mod 2 = 1][@Value <= 7]/@ID", vec!["d2"]),
        ("round(2.5) - -1", vec!["4"]),
        ("Missing", vec![]),
    ] {
        let text = mapping(
            "/Plant/Unit[@Name='Pump']",
            "{@Name}",
            &format!("rml:reference \"{reference}\""),
        );
        assert_eq!(values(&text, PLANT), expected, "{reference}");
    }
}

/// A join by scanning takes 64 million comparisons, which exceed the limit of the work.
#[test]
fn a_join_of_eight_thousand_rows_takes_linear_work() {
    let rows = 8_000;
    let units: String = (0..rows)
        .map(|row| format!("<U r='d{row}'/><D id='d{}' v='{}'/>", rows - 1 - row, row))
        .collect();
    let xml = format!("<P>{units}</P>");
    let text = mapping("/P/U", "{@r}", "rml:reference \"//D[@id=current()/@r]/@v\"");
    assert_eq!(values(&text, &xml).len(), rows);
    let parent = format!(
        "{OLD}<#U> rml:logicalSource <#S>; rr:subjectMap [ rr:template \"http://example.org/{{@r}}\" ];
        rr:predicateObjectMap [ rr:predicate ex:p; rr:objectMap [ rr:parentTriplesMap <#D>; rr:joinCondition [ rr:child \"@r\"; rr:parent \"@id\" ] ] ] .
        <#S> rml:source \"a.xml\"; rml:referenceFormulation ql:XPath; rml:iterator \"/P/U\" .
        <#D> rml:logicalSource [ rml:source \"a.xml\"; rml:referenceFormulation ql:XPath; rml:iterator \"/P/D\" ]; rr:subjectMap [ rr:template \"http://example.org/v{{@v}}\" ] ."
    );
    let made = run(&parent, &xml).unwrap();
    assert_eq!(made.quads.len(), rows);
    let first = made.quads.first().unwrap();
    assert_eq!(
        first.to_string(),
        "<http://example.org/d0> <http://example.org/p> <http://example.org/v7999>"
    );
}

#[test]
fn a_mapping_with_an_error_names_the_triples_map_and_the_remedy() {
    let good = mapping("/a", "x", "rml:reference \"@b\"");
    for (text, part) in [
        ("this is no Turtle".to_owned(), "line 1: "),
        (
            "<urn:a> <urn:b> <urn:c> .".to_owned(),
            "there is no triples map",
        ),
        (
            good.replace("ql:XPath", "ql:JSONPath"),
            "only XPath over XML",
        ),
        (
            good.replace("\"@b\"", "\"@b[\""),
            "<http://example.org/#M>: the reference `@b[`: expected",
        ),
        (
            good.replace("\"@b\"", "\"json(b)\""),
            "unknown function `json`; known are",
        ),
        (
            good.replace("\"@b\"", "\"$b\""),
            "variables are not supported",
        ),
        (good.replace("/x", "/{x"), "`{` has no counterpart"),
        (
            good.replace("rml:reference \"@b\"", "rr:column \"b\""),
            "no constant, template or reference",
        ),
        (
            good.replace("rr:subjectMap", "rr:other"),
            "it has 0 subject maps",
        ),
        (
            good.replace("\"@b\"", "\"@b\"; rr:language \"german\""),
            "use one of BCP 47",
        ),
        (
            good.replace("rr:predicate ex:p", "rr:predicate \"p\""),
            "cannot be a predicate",
        ),
    ] {
        let fault = RmlMapping::read(&text).unwrap_err().to_string();
        assert!(fault.contains(part), "{fault:?} contains {part:?}");
    }
}

#[test]
fn a_file_with_an_error_is_named_with_its_line() {
    let text = mapping("/a", "x", "rml:reference \"@b\"");
    for (xml, part) in [
        ("<a>\n<b></a>", "source `a.xml`: line 2: "),
        (
            "<!DOCTYPE a [<!ENTITY e \"x\">]><a/>",
            "remove the <!DOCTYPE",
        ),
        ("", "source `a.xml`"),
    ] {
        let fault = run(&text, xml).unwrap_err().to_string();
        assert!(fault.contains(part), "{fault:?} contains {part:?}");
    }
    let attributes: String = (0..1001).map(|number| format!(" a{number}='1'")).collect();
    let fault = run(&text, &format!("<a{attributes}/>")).unwrap_err();
    let fault = fault.to_string();
    assert!(fault.contains("more than 1000 attributes"), "{fault}");
}

#[test]
fn values_that_are_no_iri_are_findings() {
    let text = mapping("//v", "", "rr:termType rr:IRI; rml:reference \".\"")
        .replace("\"http://example.org/\"", "\"http://example.org/s\"");
    let made = run(&text, "<a><v>has space</v><v>urn:b</v><v>has space</v></a>").unwrap();
    assert_eq!(made.quads.len(), 1);
    assert_eq!(
        made.findings,
        [
            "triples map <http://example.org/#M>: `has space` is no IRI; use a template, which escapes values (2 times)"
        ]
    );
}

#[test]
fn terms_without_effect_are_findings() {
    let text = mapping("/a", "x", "rml:reference \"@b\"; rr:class ex:C").replace(
        "rr:subjectMap",
        "<http://w3id.org/rml/logicalTarget> <#T>; rr:subjectMap",
    );
    let mapping = RmlMapping::read(&text).unwrap();
    let findings: BTreeSet<&str> = mapping.findings().iter().map(String::as_str).collect();
    let found = |part: &str| findings.iter().any(|finding| finding.contains(part));
    assert!(found("`class` belongs to a subject map"), "{findings:?}");
    assert!(
        found("`logicalTarget` of the triples map is ignored"),
        "{findings:?}"
    );
    assert!(found("mixes the vocabularies"), "{findings:?}");
}

#[test]
fn a_run_ends_at_its_limits() {
    let many = format!("<a>{}</a>", "<b/>".repeat(400));
    let text = mapping("/a", "{b}{b}", "rml:reference \"b\"");
    let fault = run(&text, &many).unwrap_err().to_string();
    assert!(fault.contains("combinations of values"), "{fault}");
    for nested in [
        format!("{}1{}", "(".repeat(5000), ")".repeat(5000)),
        format!("{}1", "-".repeat(5000)),
        format!("1{}", "+1".repeat(5000)),
        format!("a{}", "/a".repeat(5000)),
    ] {
        let text = mapping("/a", "x", &format!("rml:reference \"{nested}\""));
        let fault = RmlMapping::read(&text).unwrap_err().to_string();
        assert!(fault.contains("more than"), "{fault}");
    }
}

#[test]
fn a_mapping_reads_files_of_its_folder_only() {
    let folder = Scratch::new();
    fs::create_dir(folder.0.join("maps")).unwrap();
    fs::write(folder.0.join("secret.xml"), "<a b='secret'/>").unwrap();
    fs::write(folder.0.join("maps/a.xml"), "<a b='own'/>").unwrap();
    let path = folder.0.join("maps/m.ttl");
    let read = |file: &str, folder: &mut Folder| {
        let text = mapping("/a", "x", "rml:reference \"@b\"").replace("a.xml", file);
        RmlMapping::read(&text).unwrap().run(folder)
    };
    let mut files = Folder::of(&path);
    assert_eq!(read("a.xml", &mut files).unwrap().quads.len(), 1);
    std::os::unix::fs::symlink("../secret.xml", folder.0.join("maps/link.xml")).unwrap();
    let absolute = folder.0.join("secret.xml");
    for outside in ["../secret.xml", "link.xml", absolute.to_str().unwrap()] {
        let fault = read(outside, &mut files).unwrap_err().to_string();
        assert!(fault.contains("outside of the folder"), "{fault}");
    }
    for (file, part) in [
        ("http://example.org/a.xml", "nothing is fetched"),
        (".", "is no file"),
        ("none.xml", "cannot open"),
    ] {
        let fault = read(file, &mut files).unwrap_err().to_string();
        assert!(fault.contains(part), "{fault}");
    }
    let mut given = files.with("plant", fs::read(&absolute).unwrap());
    assert_eq!(read("plant", &mut given).unwrap().quads.len(), 1);
    let mut large = given.with("plant", vec![0; (64 << 20) + 1]);
    let fault = read("plant", &mut large).unwrap_err().to_string();
    assert!(fault.contains("more than the 67108864"), "{fault}");
}

/// An empty folder, which is removed at the end.
struct Scratch(PathBuf);

impl Scratch {
    fn new() -> Self {
        let folder = std::env::temp_dir().join(format!("rml-{}", process::id()));
        drop(fs::remove_dir_all(&folder));
        fs::create_dir_all(&folder).unwrap();
        Self(folder)
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        drop(fs::remove_dir_all(&self.0));
    }
}
