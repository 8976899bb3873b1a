//! A taxonomy of operations: the functions of handling (VDI 2860) and the groups of manufacturing
//! processes (DIN 8580) as classes of capabilities, with the classes above them.
//!
//! The IRIs and the hierarchy are those of the ontologies of the Helmut Schmidt University. The
//! standards define the operations. The types of skills of this project perform operations, too.

use mtp::{Object, Triple, vocabulary as v};

/// Returns the classes as statements: each with its label, its standard as a comment, the class
/// above it, and its number if the standard numbers it. The operations of skill types follow.
#[must_use]
pub fn triples() -> Vec<Triple> {
    let mut all = Vec::new();
    let mut say = |subject: &str, predicate: &str, object| {
        all.push(Triple {
            subject: subject.to_owned(),
            predicate: predicate.to_owned(),
            object,
        });
    };
    for standard in [HANDLING, MANUFACTURING] {
        let OperationStandard {
            name, namespace, ..
        } = standard;
        let root = std::iter::once((None, standard.root, v::CAPABILITY.to_owned()));
        let below = standard.groups.iter().flat_map(|group| {
            let above = format!("{namespace}{}", group.above);
            let operations = group.operations();
            operations.map(move |(number, operation)| (number, operation, above.clone()))
        });
        for (number, operation, above) in root.chain(below) {
            let class = format!("{namespace}{operation}");
            if let Some(number) = number {
                say(&class, v::OPERATION_NUMBER, Object::Text(number.to_owned()));
            }
            say(&class, v::RDFS_SUB_CLASS_OF, Object::Iri(above));
            say(&class, v::RDFS_LABEL, Object::Text(label(operation)));
            say(&class, v::RDFS_COMMENT, Object::Text(name.to_owned()));
        }
    }
    for (skill_type, operation) in SKILL_TYPES {
        let subject = format!("urn:ua-bridge:skill-type-operation:{skill_type}");
        say(
            &subject,
            v::RDF_TYPE,
            Object::Iri(v::SKILL_TYPE_OPERATION.to_owned()),
        );
        say(
            &subject,
            v::BROWSE_NAME,
            Object::Text(skill_type.to_owned()),
        );
        say(&subject, v::NODE_NAMESPACE, Object::Text(SKILLS.to_owned()));
        say(
            &subject,
            v::PERFORMS,
            Object::Iri(format!("{VDI_2860}{operation}")),
        );
    }
    all
}

/// The namespace of the types of skills.
const SKILLS: &str = "urn:ua-bridge:skills";
/// The types of skills, and the functions of handling that their skills perform. They are those of
/// the dictionary entries of the types.
const SKILL_TYPES: [(&str, &str); 11] = [
    ("PickAndPlaceSkillType", "Handling"),
    ("GripperSkillType", "Securing"),
    ("GraspSkillType", "Tensioning"),
    ("ReleaseSkillType", "Slackening"),
    ("MotionSkillType", "Moving"),
    ("PtpMoveSkillType", "Positioning"),
    ("JointPtpMoveSkillType", "Positioning"),
    ("LinearMoveSkillType", "Guiding"),
    ("JointLinearMoveSkillType", "Guiding"),
    ("RunConveyorSkillType", "Conveying"),
    ("LocateObjectSkillType", "MeasuringPosition"),
];

/// Returns the words of a name: `AnalyzingWeight` is `Analyzing weight`.
fn label(name: &str) -> String {
    let mut label = String::new();
    for letter in name.replace('_', " ").chars() {
        if letter.is_uppercase() && label.ends_with(char::is_lowercase) {
            label.push(' ');
            label.extend(letter.to_lowercase());
        } else {
            label.push(letter);
        }
    }
    label
}

/// The namespace of the functions of handling.
pub const VDI_2860: &str = "http://www.hsu-ifa.de/ontologies/VDI2860#";
/// The namespace of the manufacturing processes.
pub const DIN_8580: &str = "http://www.w3id.org/hsu-aut/DIN8580#";

/// A standard whose operations are classes of capabilities.
struct OperationStandard {
    name: &'static str,
    namespace: &'static str,
    /// The operation above all others.
    root: &'static str,
    /// The other operations. Each is in the group of the operation above it.
    groups: &'static [OperationGroup],
}

/// The operations directly below an operation.
struct OperationGroup {
    above: &'static str,
    /// Their names, with spaces between them. A number comes before its name, as `4.3:Name`.
    names: &'static str,
}

impl OperationGroup {
    /// Returns the numbers and the names.
    fn operations(&self) -> impl Iterator<Item = (Option<&'static str>, &'static str)> {
        self.names
            .split(' ')
            .map(|name| match name.split_once(':') {
                Some((number, name)) => (Some(number), name),
                None => (None, name),
            })
    }
}

const fn below(above: &'static str, names: &'static str) -> OperationGroup {
    OperationGroup { above, names }
}

const HANDLING: OperationStandard = OperationStandard {
    name: "VDI 2860",
    namespace: VDI_2860,
    root: "Handling",
    groups: &[
        below(
            "Handling",
            "Storing AlteringQuantities Moving Securing Controlling",
        ),
        below(
            "Storing",
            "SortedStoring PartiallySortedStoring UnsortedStoring",
        ),
        below(
            "AlteringQuantities",
            "Dividing Pooling Separating Allocating Forking Merging Sorting",
        ),
        below(
            "Moving",
            "Rotating Translating Pivoting Orienting Positioning Arranging Guiding Forwarding \
             Conveying",
        ),
        below("Securing", "Holding Releasing"),
        below("Holding", "Tensioning"),
        below("Releasing", "Slackening"),
        below("Controlling", "Analyzing Measuring Counting"),
        below(
            "Analyzing",
            "AnalyzingPresence AnalyzingIdentity AnalyzingForm AnalyzingSize AnalyzingColor \
             AnalyzingWeight AnalyzingPosition AnalyzingOrientation",
        ),
        below("Measuring", "MeasuringPosition MeasuringOrientation"),
    ],
};

const MANUFACTURING: OperationStandard = OperationStandard {
    name: "DIN 8580",
    namespace: DIN_8580,
    root: "Fertigungsverfahren",
    groups: &[
        below(
            "Fertigungsverfahren",
            "1:Urformen 2:Umformen 3:Trennen 4:Fuegen 5:Beschichten \
             6:Stoffeigenschaft_aendern",
        ),
        below(
            "Urformen",
            "1.1:Urformen_aus_dem_fluessigen_Zustand \
             1.2:Urformen_aus_dem_plastischen_Zustand \
             1.3:Urformen_aus_dem_breiigen_Zustand \
             1.4:Urformen_aus_dem_koernigen_oder_pulverfoermigen_Zustand \
             1.5:Urformen_aus_dem_span-_oder_faserfoermigen_Zustand \
             1.8:Urformen_aus_dem_gas-_oder_dampffoermigen_Zustand \
             1.9:Urformen_aus_dem_ionisierten_Zustand",
        ),
        below(
            "Umformen",
            "2.1:Druckumformen 2.2:Zugdruckumformen 2.3:Zugumformen 2.4:Biegeumformen \
             2.5:Schubumformen",
        ),
        below(
            "Trennen",
            "3.1:Zerteilen 3.2:Spanen_mit_geometrisch_bestimmten_Schneiden \
             3.3:Spanen_mit_geometrisch_unbestimmten_Schneiden 3.4:Abtragen 3.5:Zerlegen \
             3.6:Reinigen",
        ),
        below(
            "Spanen_mit_geometrisch_bestimmten_Schneiden",
            "3.2.1:Drehen 3.2.2:Bohren_oder_Senken_oder_Reiben 3.2.3:Fraesen \
             3.2.4:Hobeln_oder_Stossen 3.2.5:Raeumen 3.2.6:Saegen \
             3.2.7:Feilen_oder_Raspeln 3.2.8:Buerstenspanen 3.2.9:Schaben_oder_Meisseln",
        ),
        below(
            "Spanen_mit_geometrisch_unbestimmten_Schneiden",
            "3.3.1:Schleifen_mit_rotierendem_Werkzeug 3.3.2:Bandschleifen \
             3.3.3:Hubschleifen 3.3.4:Honen 3.3.5:Laeppen 3.3.6:Strahlspanen \
             3.3.7:Gleitspanen",
        ),
        below(
            "Fuegen",
            "4.1:Zusammensetzen 4.2:Fuellen 4.3:An-_und_Einpressen \
             4.4:Fuegen_durch_Urformen 4.5:Fuegen_durch_Umformen \
             4.6:Fuegen_durch_Schweissen 4.7:Fuegen_durch_Loeten 4.8:Kleben \
             4.9:Textiles_Fuegen",
        ),
        below(
            "Zusammensetzen",
            "4.1.1:Auflegen_oder_Aufsetzen_oder_Schichten 4.1.2:Einlegen_oder_Einsetzen \
             4.1.3:Ineinanderschieben 4.1.4:Einhaengen 4.1.5:Einrenken \
             4.1.6:Federnd_Einspreizen",
        ),
        below(
            "Fuellen",
            "4.2.1:Einfuellen 4.2.2:Traenken_oder_Impraegnieren",
        ),
        below(
            "An-_und_Einpressen",
            "4.3.1:Schrauben 4.3.2:Klemmen 4.3.3:Klammern 4.3.4:Fuegen_durch_Presspassung \
             4.3.5:Nageln_oder_Verstiften_oder_Einschlagen 4.3.6:Verkeilen \
             4.3.7:Verspannen",
        ),
        below(
            "Beschichten",
            "5.1:Beschichten_aus_dem_fluessigen_Zustand \
             5.2:Beschichten_aus_dem_plastischen_Zustand \
             5.3:Beschichten_aus_dem_breiigen_Zustand \
             5.4:Beschichten_aus_dem_koernigen_oder_pulverfoermigen_Zustand \
             5.6:Beschichten_durch_Schweissen 5.7:Beschichten_durch_Loeten \
             5.8:Beschichten_aus_dem_gas-_oder_dampffoermigen_Zustand \
             5.9:Beschichten_aus_dem_ionisierten_Zustand",
        ),
        below(
            "Stoffeigenschaft_aendern",
            "6.1:Verfestigen_durch_Umformen 6.2:Waermebehandeln \
             6.3:Thermomechanisches_Behandeln 6.4:Sintern_oder_Brennen 6.5:Magnetisieren \
             6.6:Bestrahlen 6.7:Photochemische_Verfahren",
        ),
    ],
};

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;
    use std::sync::Arc;

    use super::*;
    use crate::{Knowledge, KnowledgeSource, SourceKind, ValueQuery};

    #[test]
    fn each_operation_has_one_name_and_is_below_an_operation_before_it() {
        for standard in [HANDLING, MANUFACTURING] {
            let mut known = BTreeSet::from([standard.root]);
            for group in standard.groups {
                let above = group.above;
                assert!(known.contains(above), "{above} is not there yet");
                for (_, name) in group.operations() {
                    assert!(known.insert(name), "{name} is there twice");
                }
            }
        }
    }

    #[test]
    fn an_operation_is_below_all_that_it_is_a_kind_of() {
        let knowledge = Arc::new(Knowledge::new().unwrap());
        let source = KnowledgeSource::new(SourceKind::File, "operations");
        knowledge.replace(&source, &triples(), 1).unwrap();
        let below = |class: &str, above: &str| {
            let query = format!(
                "SELECT (COUNT(*) AS ?n) {{ <{class}> \
                 <http://www.w3.org/2000/01/rdf-schema#subClassOf> <{above}> }}"
            );
            ValueQuery::read(&query).unwrap().value(&knowledge).unwrap() != 0
        };
        for (base, name, above) in [
            (VDI_2860, "Tensioning", "Securing"),
            (VDI_2860, "AnalyzingWeight", "Handling"),
            (DIN_8580, "Schrauben", "Fuegen"),
        ] {
            let (class, above) = (format!("{base}{name}"), format!("{base}{above}"));
            assert!(
                below(&class, &above) && below(&class, v::CAPABILITY),
                "{name}"
            );
            assert!(!below(&above, &class), "{name}");
        }
    }

    #[test]
    fn the_main_groups_and_groups_of_din_8580_have_their_numbers() {
        let knowledge = Arc::new(Knowledge::new().unwrap());
        let source = KnowledgeSource::new(SourceKind::File, "operations");
        knowledge.replace(&source, &triples(), 1).unwrap();
        let value = |query: &str| ValueQuery::read(query).unwrap().value(&knowledge).unwrap();
        let number = v::OPERATION_NUMBER;
        let count = |pattern: &str| {
            value(&format!(
                "SELECT (COUNT(?number) AS ?n) {{ ?operation <{number}> ?number \
                 FILTER(REGEX(?number, '{pattern}')) }}"
            ))
        };
        // 6 main groups, and 7 + 5 + 6 + 9 + 8 + 7 groups.
        assert_eq!((count("^.$"), count("^.[.].$")), (6.into(), 42.into()));
        for (name, expected) in [
            ("Urformen_aus_dem_ionisierten_Zustand", "1.9"),
            ("Beschichten_durch_Schweissen", "5.6"),
            ("Schrauben", "4.3.1"),
        ] {
            let found = format!("SELECT ?number {{ <{DIN_8580}{name}> <{number}> ?number }}");
            assert_eq!(value(&found), expected, "{name}");
        }
    }

    #[test]
    fn skills_are_found_by_the_operation_of_their_type_or_capability() {
        let (skills, own) = ("urn:ua-bridge:skills", "urn:example:capability:grasp");
        let text = "@prefix css: <http://www.w3id.org/hsu-aut/css#> .
@prefix ua: <urn:ua-bridge:plant#> .
@prefix rdfs: <http://www.w3.org/2000/01/rdf-schema#> .
<urn:type:grasp> a rdfs:Class ; ua:browseName 'GraspSkillType' ; ua:nodeNamespace 'SKILLS' ;
    rdfs:subClassOf <urn:type:grasp> .
<urn:type:own> a rdfs:Class ; ua:browseName 'OwnType' ; ua:nodeNamespace 'urn:maker' ;
    rdfs:subClassOf <urn:type:grasp> , <urn:type:own> .
<urn:gripper> css:providesSkill <urn:gripper#Hold> ; rdfs:label 'gripper' .
<urn:gripper#Hold> a css:Skill , <urn:type:own> ; rdfs:label 'Hold' .
<urn:press> css:providesSkill <urn:press#Fix> ; rdfs:label 'press' .
<urn:press#Fix> a css:Skill ; rdfs:label 'Fix' .
<urn:provided> css:isRealizedBySkill <urn:press#Fix> ; a <OWN> .
<OWN> rdfs:subClassOf <http://www.w3id.org/hsu-aut/DIN8580#Schrauben> .";
        let knowledge = Knowledge::new().unwrap();
        let source = |name| KnowledgeSource::new(SourceKind::File, name);
        knowledge
            .replace(&source("operations"), &triples(), 1)
            .unwrap();
        let text = text.replace("SKILLS", skills).replace("OWN", own);
        knowledge
            .replace_turtle(&source("plant"), &text, 1)
            .unwrap();
        let found = |operation: &str| {
            let given = [("operation".to_owned(), operation.to_owned())];
            let answer = knowledge.ask("operations", &given).unwrap();
            let text = |row, column| crate::QuestionAnswer::text(row, column).to_owned();
            let rows = answer.rows.iter();
            let rows = rows.map(|row| (text(row, "name"), text(row, "by"), text(row, "number")));
            rows.collect::<Vec<_>>()
        };
        let row = |name: &str, by: &str, number: &str| {
            vec![(name.to_owned(), by.to_owned(), number.to_owned())]
        };
        // A type of a maker below the type, and an operation above that of the type.
        assert_eq!(
            found(&format!("{VDI_2860}Tensioning")),
            row("Hold", "type", "")
        );
        assert_eq!(
            found(&format!("{VDI_2860}Securing")),
            row("Hold", "type", "")
        );
        assert_eq!(
            found(&format!("{DIN_8580}Fuegen")),
            row("Fix", "capability", "4")
        );
        assert_eq!(found(&format!("{DIN_8580}Kleben")), []);
    }

    #[test]
    fn a_label_has_the_words_of_the_name() {
        assert_eq!(label("AnalyzingWeight"), "Analyzing weight");
        assert_eq!(label("An-_und_Einpressen"), "An- und Einpressen");
        assert_eq!(label("Drehen"), "Drehen");
    }
}
