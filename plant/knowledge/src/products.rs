//! Products of STEP files as statements: the box around each product, and the parts of assemblies.

use std::collections::{HashMap, HashSet};

use mtp::{Object, Triple, escaped, vocabulary as v};
use step_files::{OccurrencePose, StepProduct, StepProducts};

/// Returns the products of a file as statements. The IRIs have the name of the source and the ids
/// of the products. Lengths are in metres.
#[must_use]
pub fn triples(products: &StepProducts, source: &str) -> Vec<Triple> {
    let iris = iris(products, source);
    let mut all = Statements(Vec::new());
    for product in &products.products {
        let Some(iri) = iris.get(&product.entity) else {
            continue;
        };
        all.product(iri, product);
        for (number, occurrence) in product.occurrences.iter().enumerate() {
            let Some(part) = iris.get(&occurrence.part) else {
                continue;
            };
            let of = format!("{iri}/occurrence/{}", number + 1);
            all.say(iri, v::HAS_OCCURRENCE, Object::Iri(of.clone()));
            all.say(&of, v::RDF_TYPE, Object::Iri(v::OCCURRENCE.to_owned()));
            all.say(&of, v::OF_PRODUCT, Object::Iri(part.clone()));
            for name in [&occurrence.name, &occurrence.id].into_iter().take(1) {
                all.say(&of, v::RDFS_LABEL, Object::Text(name.clone()));
            }
            if let Some(pose) = &occurrence.pose {
                all.say(&of, v::POSE, Object::Text(pose_text(pose)));
            }
        }
    }
    all.0
}

/// Returns the IRI of each product, by its number in the file. Products without an id of their own
/// have the number in their IRI.
fn iris(products: &StepProducts, source: &str) -> HashMap<u64, String> {
    let mut once = HashSet::new();
    let mut twice = HashSet::new();
    for product in &products.products {
        if !once.insert(&product.id) {
            twice.insert(&product.id);
        }
    }
    let iri = |product: &StepProduct| {
        let (source, id) = (escaped(source), escaped(&product.id));
        let mut iri = format!("urn:ua-bridge:product:{source}:{id}");
        if product.id.is_empty() || twice.contains(&product.id) {
            // No escaped id has this character, so that no other product has the IRI.
            iri.push_str(&format!(";{}", product.entity));
        }
        (product.entity, iri)
    };
    products.products.iter().map(iri).collect()
}

/// Returns a pose as `ua:pose` has it: the position in metres, and the rotations about the fixed
/// axes x, y and z in radians.
#[must_use]
pub fn pose_text(pose: &OccurrencePose) -> String {
    let [x, y, z] = pose.position;
    let [[xx, xy, xz], [_, yy, yz], [_, zy, zz]] = pose.axes;
    let flat = xx.hypot(xy);
    let (roll, pitch, yaw) = if flat > 1e-9 {
        (yz.atan2(zz), (-xz).atan2(flat), xy.atan2(xx))
    } else {
        // x is vertical, so that only the sum or difference of the other rotations matters.
        ((-zy).atan2(yy), (-xz).atan2(flat), 0.0)
    };
    // A micrometre and a microradian are beyond any shape; -0 is 0.
    let shown = [x, y, z, roll, pitch, yaw].map(|number| {
        let rounded = (number * 1e6).round() / 1e6 + 0.0;
        rounded.to_string()
    });
    shown.join(" ")
}

struct Statements(Vec<Triple>);

impl Statements {
    fn say(&mut self, subject: &str, predicate: &str, object: Object) {
        self.0.push(Triple {
            subject: subject.to_owned(),
            predicate: predicate.to_owned(),
            object,
        });
    }

    fn product(&mut self, iri: &str, product: &StepProduct) {
        self.say(iri, v::RDF_TYPE, Object::Iri(v::PRODUCT.to_owned()));
        self.say(iri, v::PRODUCT_ID, Object::Text(product.id.clone()));
        self.say(iri, v::RDFS_LABEL, Object::Text(product.name.clone()));
        let Some(extents) = &product.extents else {
            return;
        };
        let (size, centre) = (extents.size().map(rounded), extents.centre().map(rounded));
        let sizes = [v::SIZE_X, v::SIZE_Y, v::SIZE_Z];
        let centres = [v::CENTRE_X, v::CENTRE_Y, v::CENTRE_Z];
        let pairs = sizes.iter().zip(size).chain(centres.iter().zip(centre));
        for (predicate, number) in pairs {
            self.say(iri, predicate, Object::Number(number));
        }
        let size = size.map(|number| number.to_string()).join(" ");
        self.say(iri, v::BOX, Object::Text(size));
    }
}

/// Rounds a length in metres to a hundredth of a millimetre, the limit of the bounds.
fn rounded(metres: f64) -> f64 {
    (metres * 1e5).round() / 1e5 + 0.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_product_has_an_iri_of_its_own_whatever_its_id_is() {
        let product = |entity: u64, id: &str| StepProduct {
            entity,
            id: id.to_owned(),
            name: String::new(),
            extents: None,
            occurrences: Vec::new(),
        };
        let ids = ["4711", "4711#2", "4711;2", "a b<>", "%2342", "", "4711"];
        let numbered = (1..).zip(ids);
        let products = numbered.map(|(entity, id)| product(entity, id)).collect();
        let findings = Vec::new();
        let all = triples(&StepProducts { products, findings }, "parts of #1.step");
        let of_type = all.iter().filter(|triple| triple.predicate == v::RDF_TYPE);
        let iris: Vec<&str> = of_type.map(|triple| triple.subject.as_str()).collect();
        let base = "urn:ua-bridge:product:parts%20of%20%231.step:";
        let expected = [
            "4711;1",
            "4711%232",
            "4711%3B2",
            "a%20b%3C%3E",
            "%252342",
            ";6",
            "4711;7",
        ];
        assert_eq!(iris, expected.map(|end| format!("{base}{end}")));
    }

    #[test]
    fn a_pose_has_the_rotations_of_its_axes() {
        // Turned by 90 degrees about z, and moved.
        let pose = OccurrencePose {
            position: [0.1, -0.02, 0.0],
            axes: [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]],
        };
        assert_eq!(pose_text(&pose), "0.1 -0.02 0 0 0 1.570796");
        // Turned by 90 degrees about y: x points down.
        let pose = OccurrencePose {
            position: [0.0; 3],
            axes: [[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]],
        };
        assert_eq!(pose_text(&pose), "0 0 0 0 1.570796 0");
    }
}
