//! The published test cases of RML for XML: 38 of `rml-test-cases`, in the old vocabulary, and 7 of
//! `rml-io`, in the new one.
#![expect(clippy::unwrap_used, reason = "a test may")]

use std::fs;
use std::path::Path;

use oxrdf::Dataset;
use oxrdf::dataset::CanonicalizationAlgorithm;
use oxttl::NQuadsParser;
use rml::{Folder, RmlMapping};
use test_data::foreign;

#[test]
fn all_published_cases_of_the_old_vocabulary_give_the_expected_statements() {
    passes("rml/rml-test-cases", 38);
}

#[test]
fn all_published_cases_of_the_new_vocabulary_give_the_expected_statements() {
    passes("rml/rml-io", 7);
}

fn passes(suite: &str, count: usize) {
    let Some(folder) = foreign(suite) else { return };
    let mut cases: Vec<_> = fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.join("mapping.ttl").exists())
        .collect();
    cases.sort();
    assert_eq!(cases.len(), count, "cases of {suite}");
    let failed: Vec<String> = cases
        .iter()
        .filter_map(|case| {
            let fault = check(case).err()?;
            Some(format!("{}: {fault}", case.file_name()?.display()))
        })
        .collect();
    let passed = cases.len() - failed.len();
    assert!(
        failed.is_empty(),
        "{passed} of {count} cases of {suite} pass, and these fail:\n{}",
        failed.join("\n")
    );
}

/// Runs a case. A case without a file of expected statements expects an error.
fn check(case: &Path) -> Result<(), String> {
    let path = case.join("mapping.ttl");
    let text = fs::read_to_string(&path).unwrap();
    let result = RmlMapping::read(&text).and_then(|mapping| mapping.run(&mut Folder::of(&path)));
    let expected = ["output.nq", "default.nq"]
        .iter()
        .find_map(|name| fs::read_to_string(case.join(name)).ok());
    match (result, expected) {
        (Err(_), None) => Ok(()),
        // The graph of RMLTC0007h is a literal, so that it has no statement.
        (Err(_), Some(expected)) if expected.trim().is_empty() => Ok(()),
        (Err(fault), Some(_)) => Err(fault.to_string()),
        (Ok(output), None) => Err(format!(
            "an error was expected, and not {} statements",
            output.quads.len()
        )),
        (Ok(output), Some(expected)) => {
            let wanted = NQuadsParser::new().for_slice(&expected);
            let mut wanted: Dataset = wanted.map(Result::unwrap).collect();
            let mut made: Dataset = output.quads.into_iter().collect();
            wanted.canonicalize(CanonicalizationAlgorithm::Unstable);
            made.canonicalize(CanonicalizationAlgorithm::Unstable);
            if wanted == made {
                Ok(())
            } else {
                Err(format!("expected:\n{wanted}made:\n{made}"))
            }
        }
    }
}
