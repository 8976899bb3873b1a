//! Fuzzes STEP files with arbitrary bytes.

use step_files::StepProducts;

/// Reads the products of a file. Each product has extents or a finding; extents are finite and in
/// order; a finding names a line of the file.
pub fn step(input: &[u8]) {
    let Ok(read) = StepProducts::read(input) else {
        return;
    };
    let last = input.split(|byte| *byte == b'\n').count();
    for found in &read.findings {
        assert!(
            found.line.is_none_or(|line| (1..=last).contains(&line)),
            "{found}"
        );
    }
    for product in &read.products {
        let findings = read.findings.iter();
        let findings = findings
            .filter(|found| found.product == product.entity)
            .count();
        assert_eq!(
            findings,
            usize::from(product.extents.is_none()),
            "{product:?}"
        );
        if let Some(extents) = &product.extents {
            let pairs = extents.min.iter().zip(&extents.max);
            for (min, max) in pairs {
                assert!(
                    min.is_finite() && max.is_finite() && *min <= max + 1e-4,
                    "{product:?}"
                );
            }
        }
    }
}
