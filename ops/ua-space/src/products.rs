//! `ua-space products`: the products of STEP files with their extents.

use std::io::{self, Write as _};

use knowledge::products::pose_text;
use serde_json::json;
use step_files::{StepProduct, StepProducts};

use crate::arguments::ProductsArguments;
use crate::exit::CommandFailure;
use crate::input::{name, read};
use crate::live::{TextTable, harmless, is_coloured};
use crate::report;

/// Runs `ua-space products`.
pub(crate) fn products(arguments: &ProductsArguments) -> Result<(), CommandFailure> {
    let mut files = Vec::new();
    for file in &arguments.files {
        let products = StepProducts::read(&read(file)?)
            .map_err(|fault| CommandFailure::Data(harmless(&format!("{}: {fault}", name(file)))))?;
        files.push((name(file), products));
    }
    let mut out = io::BufWriter::new(io::stdout().lock());
    if arguments.json {
        let all: Vec<_> = files
            .iter()
            .map(|(name, products)| file_json(name, products))
            .collect();
        serde_json::to_writer_pretty(&mut out, &all).map_err(io::Error::from)?;
        writeln!(out)?;
    } else {
        let columns = ["ID", "PRODUCT", "X mm", "Y mm", "Z mm", "PARTS"];
        let mut table = TextTable::new(columns.map(str::to_owned)).yielding([1, 0]);
        for product in files.iter().flat_map(|(_, products)| &products.products) {
            table.row(cells(product));
        }
        table.write(&mut out, is_coloured())?;
    }
    out.flush()?;
    drop(out);
    let mut count = 0;
    for (name, products) in &files {
        for found in &products.findings {
            report::warn(&harmless(&format!("{name}: {found}")));
            count += 1;
        }
    }
    match count {
        0 => Ok(()),
        1 => Err(CommandFailure::Data(
            "a product has no proven extents".to_owned(),
        )),
        count => Err(CommandFailure::Data(format!(
            "{count} products have no proven extents"
        ))),
    }
}

fn cells(product: &StepProduct) -> [String; 6] {
    let sizes = match &product.extents {
        Some(extents) => extents.size().map(|size| format!("{:.2}", size * 1e3)),
        None => ["-", "-", "-"].map(str::to_owned),
    };
    let [x, y, z] = sizes;
    let parts = match product.occurrences.len() {
        0 => "-".to_owned(),
        count => count.to_string(),
    };
    [product.id.clone(), product.name.clone(), x, y, z, parts]
}

/// Returns the products of a file. Lengths are in metres.
fn file_json(name: &str, products: &StepProducts) -> serde_json::Value {
    let all = products.products.iter().map(|product| {
        let occurrences = product.occurrences.iter().map(|occurrence| {
            json!({
                "id": occurrence.id,
                "name": occurrence.name,
                "part": occurrence.part,
                "pose": occurrence.pose.as_ref().map(pose_text),
            })
        });
        let finding = products
            .findings
            .iter()
            .find(|found| found.product == product.entity);
        json!({
            "entity": product.entity,
            "id": product.id,
            "name": product.name,
            "size": product.extents.map(|extents| extents.size().map(micrometres)),
            "min": product.extents.map(|extents| extents.min.map(micrometres)),
            "max": product.extents.map(|extents| extents.max.map(micrometres)),
            "finding": finding.map(ToString::to_string),
            "occurrences": occurrences.collect::<Vec<_>>(),
        })
    });
    json!({ "file": name, "products": all.collect::<Vec<_>>() })
}

/// Rounds a length in metres to a micrometre.
fn micrometres(metres: f64) -> f64 {
    (metres * 1e6).round() / 1e6 + 0.0
}
