//! A taxonomy of operations: the functions of handling (VDI 2860) and the groups of manufacturing
//! processes (DIN 8580) as classes of capabilities, with the classes above them.
//!
//! The IRIs and the hierarchy are those of the ontologies of the Helmut Schmidt University. The
//! standards define the operations.

use mtp::{Object, Triple, vocabulary as v};

/// Returns the classes as statements: each with its label, its standard as a comment, and the class
/// above it.
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
        let root = std::iter::once((standard.root, v::CAPABILITY.to_owned()));
        let below = standard.groups.iter().flat_map(|group| {
            let above = format!("{namespace}{}", group.above);
            let names = group.names.split(' ');
            names.map(move |operation| (operation, above.clone()))
        });
        for (operation, above) in root.chain(below) {
            let class = format!("{namespace}{operation}");
            say(&class, v::RDFS_SUB_CLASS_OF, Object::Iri(above));
            say(&class, v::RDFS_LABEL, Object::Text(label(operation)));
            say(&class, v::RDFS_COMMENT, Object::Text(name.to_owned()));
        }
    }
    all
}

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
    /// Their names, with spaces between them.
    names: &'static str,
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
            "Urformen Umformen Trennen Fuegen Beschichten Stoffeigenschaft_aendern",
        ),
        below(
            "Umformen",
            "Druckumformen Zugdruckumformen Zugumformen Biegeumformen Schubumformen",
        ),
        below(
            "Trennen",
            "Zerteilen Spanen_mit_geometrisch_bestimmten_Schneiden \
             Spanen_mit_geometrisch_unbestimmten_Schneiden Abtragen Zerlegen Reinigen",
        ),
        below(
            "Spanen_mit_geometrisch_bestimmten_Schneiden",
            "Drehen Bohren_oder_Senken_oder_Reiben Fraesen Hobeln_oder_Stossen Raeumen Saegen \
             Feilen_oder_Raspeln Buerstenspanen Schaben_oder_Meisseln",
        ),
        below(
            "Spanen_mit_geometrisch_unbestimmten_Schneiden",
            "Schleifen_mit_rotierendem_Werkzeug Bandschleifen Hubschleifen Honen Laeppen \
             Strahlspanen Gleitspanen",
        ),
        below(
            "Fuegen",
            "Zusammensetzen Fuellen An-_und_Einpressen Fuegen_durch_Urformen \
             Fuegen_durch_Umformen Fuegen_durch_Schweissen Fuegen_durch_Loeten Kleben \
             Textiles_Fuegen",
        ),
        below(
            "Zusammensetzen",
            "Auflegen_oder_Aufsetzen_oder_Schichten Einlegen_oder_Einsetzen Ineinanderschieben \
             Einhaengen Einrenken Federnd_Einspreizen",
        ),
        below("Fuellen", "Einfuellen Traenken_oder_Impraegnieren"),
        below(
            "An-_und_Einpressen",
            "Schrauben Klemmen Klammern Fuegen_durch_Presspassung \
             Nageln_oder_Verstiften_oder_Einschlagen Verkeilen Verspannen",
        ),
        below(
            "Stoffeigenschaft_aendern",
            "Verfestigen_durch_Umformen Waermebehandeln Thermomechanisches_Behandeln \
             Sintern_oder_Brennen Magnetisieren Bestrahlen Photochemische_Verfahren",
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
            for OperationGroup { above, names } in standard.groups {
                assert!(known.contains(above), "{above} is not there yet");
                for name in names.split(' ') {
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
    fn a_label_has_the_words_of_the_name() {
        assert_eq!(label("AnalyzingWeight"), "Analyzing weight");
        assert_eq!(label("An-_und_Einpressen"), "An- und Einpressen");
        assert_eq!(label("Drehen"), "Drehen");
    }
}
