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
    for (standard, base, operations) in [
        ("VDI 2860", VDI_2860, HANDLING),
        ("DIN 8580", DIN_8580, MANUFACTURING),
    ] {
        for (name, above) in operations {
            let class = format!("{base}{name}");
            let above = match *above {
                "" => v::CAPABILITY.to_owned(),
                above => format!("{base}{above}"),
            };
            say(&class, v::RDFS_SUB_CLASS_OF, Object::Iri(above));
            say(&class, v::RDFS_LABEL, Object::Text(label(name)));
            say(&class, v::RDFS_COMMENT, Object::Text(standard.to_owned()));
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

/// The name of an operation, and the name of the more general operation; empty for the root.
type Operation = (&'static str, &'static str);

const HANDLING: &[Operation] = &[
    ("Handling", ""),
    ("Storing", "Handling"),
    ("SortedStoring", "Storing"),
    ("PartiallySortedStoring", "Storing"),
    ("UnsortedStoring", "Storing"),
    ("AlteringQuantities", "Handling"),
    ("Dividing", "AlteringQuantities"),
    ("Pooling", "AlteringQuantities"),
    ("Separating", "AlteringQuantities"),
    ("Allocating", "AlteringQuantities"),
    ("Forking", "AlteringQuantities"),
    ("Merging", "AlteringQuantities"),
    ("Sorting", "AlteringQuantities"),
    ("Moving", "Handling"),
    ("Rotating", "Moving"),
    ("Translating", "Moving"),
    ("Pivoting", "Moving"),
    ("Orienting", "Moving"),
    ("Positioning", "Moving"),
    ("Arranging", "Moving"),
    ("Guiding", "Moving"),
    ("Forwarding", "Moving"),
    ("Conveying", "Moving"),
    ("Securing", "Handling"),
    ("Holding", "Securing"),
    ("Releasing", "Securing"),
    ("Tensioning", "Holding"),
    ("Slackening", "Releasing"),
    ("Controlling", "Handling"),
    ("Analyzing", "Controlling"),
    ("AnalyzingPresence", "Analyzing"),
    ("AnalyzingIdentity", "Analyzing"),
    ("AnalyzingForm", "Analyzing"),
    ("AnalyzingSize", "Analyzing"),
    ("AnalyzingColor", "Analyzing"),
    ("AnalyzingWeight", "Analyzing"),
    ("AnalyzingPosition", "Analyzing"),
    ("AnalyzingOrientation", "Analyzing"),
    ("Measuring", "Controlling"),
    ("MeasuringPosition", "Measuring"),
    ("MeasuringOrientation", "Measuring"),
    ("Counting", "Controlling"),
];

const MANUFACTURING: &[Operation] = &[
    ("Fertigungsverfahren", ""),
    ("Urformen", "Fertigungsverfahren"),
    ("Umformen", "Fertigungsverfahren"),
    ("Druckumformen", "Umformen"),
    ("Zugdruckumformen", "Umformen"),
    ("Zugumformen", "Umformen"),
    ("Biegeumformen", "Umformen"),
    ("Schubumformen", "Umformen"),
    ("Trennen", "Fertigungsverfahren"),
    ("Zerteilen", "Trennen"),
    ("Spanen_mit_geometrisch_bestimmten_Schneiden", "Trennen"),
    ("Drehen", "Spanen_mit_geometrisch_bestimmten_Schneiden"),
    (
        "Bohren_oder_Senken_oder_Reiben",
        "Spanen_mit_geometrisch_bestimmten_Schneiden",
    ),
    ("Fraesen", "Spanen_mit_geometrisch_bestimmten_Schneiden"),
    (
        "Hobeln_oder_Stossen",
        "Spanen_mit_geometrisch_bestimmten_Schneiden",
    ),
    ("Raeumen", "Spanen_mit_geometrisch_bestimmten_Schneiden"),
    ("Saegen", "Spanen_mit_geometrisch_bestimmten_Schneiden"),
    (
        "Feilen_oder_Raspeln",
        "Spanen_mit_geometrisch_bestimmten_Schneiden",
    ),
    (
        "Buerstenspanen",
        "Spanen_mit_geometrisch_bestimmten_Schneiden",
    ),
    (
        "Schaben_oder_Meisseln",
        "Spanen_mit_geometrisch_bestimmten_Schneiden",
    ),
    ("Spanen_mit_geometrisch_unbestimmten_Schneiden", "Trennen"),
    (
        "Schleifen_mit_rotierendem_Werkzeug",
        "Spanen_mit_geometrisch_unbestimmten_Schneiden",
    ),
    (
        "Bandschleifen",
        "Spanen_mit_geometrisch_unbestimmten_Schneiden",
    ),
    (
        "Hubschleifen",
        "Spanen_mit_geometrisch_unbestimmten_Schneiden",
    ),
    ("Honen", "Spanen_mit_geometrisch_unbestimmten_Schneiden"),
    ("Laeppen", "Spanen_mit_geometrisch_unbestimmten_Schneiden"),
    (
        "Strahlspanen",
        "Spanen_mit_geometrisch_unbestimmten_Schneiden",
    ),
    (
        "Gleitspanen",
        "Spanen_mit_geometrisch_unbestimmten_Schneiden",
    ),
    ("Abtragen", "Trennen"),
    ("Zerlegen", "Trennen"),
    ("Reinigen", "Trennen"),
    ("Fuegen", "Fertigungsverfahren"),
    ("Zusammensetzen", "Fuegen"),
    ("Auflegen_oder_Aufsetzen_oder_Schichten", "Zusammensetzen"),
    ("Einlegen_oder_Einsetzen", "Zusammensetzen"),
    ("Ineinanderschieben", "Zusammensetzen"),
    ("Einhaengen", "Zusammensetzen"),
    ("Einrenken", "Zusammensetzen"),
    ("Federnd_Einspreizen", "Zusammensetzen"),
    ("Fuellen", "Fuegen"),
    ("Einfuellen", "Fuellen"),
    ("Traenken_oder_Impraegnieren", "Fuellen"),
    ("An-_und_Einpressen", "Fuegen"),
    ("Schrauben", "An-_und_Einpressen"),
    ("Klemmen", "An-_und_Einpressen"),
    ("Klammern", "An-_und_Einpressen"),
    ("Fuegen_durch_Presspassung", "An-_und_Einpressen"),
    (
        "Nageln_oder_Verstiften_oder_Einschlagen",
        "An-_und_Einpressen",
    ),
    ("Verkeilen", "An-_und_Einpressen"),
    ("Verspannen", "An-_und_Einpressen"),
    ("Fuegen_durch_Urformen", "Fuegen"),
    ("Fuegen_durch_Umformen", "Fuegen"),
    ("Fuegen_durch_Schweissen", "Fuegen"),
    ("Fuegen_durch_Loeten", "Fuegen"),
    ("Kleben", "Fuegen"),
    ("Textiles_Fuegen", "Fuegen"),
    ("Beschichten", "Fertigungsverfahren"),
    ("Stoffeigenschaft_aendern", "Fertigungsverfahren"),
    ("Verfestigen_durch_Umformen", "Stoffeigenschaft_aendern"),
    ("Waermebehandeln", "Stoffeigenschaft_aendern"),
    ("Thermomechanisches_Behandeln", "Stoffeigenschaft_aendern"),
    ("Sintern_oder_Brennen", "Stoffeigenschaft_aendern"),
    ("Magnetisieren", "Stoffeigenschaft_aendern"),
    ("Bestrahlen", "Stoffeigenschaft_aendern"),
    ("Photochemische_Verfahren", "Stoffeigenschaft_aendern"),
];

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;
    use std::sync::Arc;

    use super::*;
    use crate::{Knowledge, KnowledgeSource, SourceKind, ValueQuery};

    #[test]
    fn each_operation_has_one_name_and_is_below_an_operation_before_it() {
        for operations in [HANDLING, MANUFACTURING] {
            let mut known: BTreeSet<&str> = BTreeSet::new();
            for (name, above) in operations {
                assert!(
                    known.contains(above) || known.is_empty(),
                    "{name} is below {above}"
                );
                assert!(known.insert(name), "{name} is there twice");
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
