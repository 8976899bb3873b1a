//! Helpers of the tests of statements.

use std::collections::BTreeSet;

use mtp::vocabulary as v;
use mtp::{Object, Triple};

/// Returns the number of the subjects of a class.
pub(crate) fn of_class(all: &[Triple], class: &str) -> usize {
    let of = all
        .iter()
        .filter(|one| one.predicate == v::RDF_TYPE && one.object == Object::Iri(class.to_owned()));
    let subjects: BTreeSet<&str> = of.map(|one| &*one.subject).collect();
    subjects.len()
}
