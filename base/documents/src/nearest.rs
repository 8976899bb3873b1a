//! Search for the known name that a misspelt name may mean.

/// Returns the name among `known` that is nearest to `name`, if at most a third of the letters
/// differ.
pub fn nearest<'k>(name: &str, known: impl IntoIterator<Item = &'k str>) -> Option<&'k str> {
    if name.chars().count() > LONGEST {
        return None;
    }
    let limit = (name.chars().count() / 3).max(1);
    let is_alike =
        |candidate: &&str| candidate.chars().count().abs_diff(name.chars().count()) <= limit;
    let distances = known
        .into_iter()
        .filter(is_alike)
        .map(|candidate| (distance(name, candidate), candidate));
    distances
        .filter(|(distance, _)| *distance <= limit)
        .min_by_key(|(distance, _)| *distance)
        .map(|(_, name)| name)
}

const LONGEST: usize = 64;

/// Counts the letters to insert, delete, change or swap with their neighbour, case apart (the
/// optimal string alignment distance).
fn distance(a: &str, b: &str) -> usize {
    let (a, b) = (a.to_lowercase(), b.to_lowercase());
    let mut above: Vec<usize> = (0..=b.chars().count()).collect();
    // The row of the letter before the last letter: the distance after a swap of both letters
    // continues from it.
    let mut before: Vec<usize> = Vec::new();
    let mut last = None;
    for (line, x) in a.chars().enumerate() {
        let mut row = Vec::with_capacity(above.len());
        let mut left = line + 1;
        row.push(left);
        let mut behind = None;
        for (at, y) in b.chars().enumerate() {
            let cell = |row: &[usize], at: usize| row.get(at).copied().unwrap_or(usize::MAX / 2);
            let mut best = (cell(&above, at) + usize::from(x != y))
                .min(left + 1)
                .min(cell(&above, at + 1) + 1);
            if last == Some(y) && behind == Some(x) {
                best = best.min(cell(&before, at.saturating_sub(1)) + 1);
            }
            row.push(best);
            left = best;
            behind = Some(y);
        }
        before = std::mem::replace(&mut above, row);
        last = Some(x);
    }
    above.last().copied().unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_misspelt_name_finds_its_neighbour_and_a_strange_one_none() {
        let known = ["publisher_id", "interface", "ttl"];
        assert_eq!(nearest("interfce", known), Some("interface"));
        assert_eq!(nearest("PublisherId", known), Some("publisher_id"));
        assert_eq!(nearest("tttl", known), Some("ttl"));
        assert_eq!(nearest("tlt", known), Some("ttl"));
        assert_eq!(nearest("colour", known), None);
        assert_eq!(nearest(&"i".repeat(100_000), known), None);
    }

    #[test]
    fn the_distance_counts_letters() {
        for (a, b, expected) in [
            ("", "", 0),
            ("", "abc", 3),
            ("abc", "", 3),
            ("kitten", "sitting", 3),
            ("Ab", "aB", 0),
            ("naem", "name", 1),
            ("ca", "abc", 3),
            ("orgiin", "origin", 1),
        ] {
            assert_eq!(distance(a, b), expected, "{a} {b}");
        }
    }
}
