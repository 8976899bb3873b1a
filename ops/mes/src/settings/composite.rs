//! The work of a process whose steps one composite does together.

use skills::yaml::{DocumentNode, YamlFindingCode};

use super::Reading;
use crate::read_process::USUALLY_APPROACH;

impl Reading<'_, '_> {
    pub(super) fn job(&mut self, node: &DocumentNode) -> Option<skills::Job> {
        let keys = ["pick", "place", "approach", "shape"];
        let [pick, place, approach, shape] = self.reader.map(node, keys)?;
        let pick = self
            .reader
            .needed(pick, "pick", node.place)
            .and_then(|node| self.position(node));
        let place = self
            .reader
            .needed(place, "place", node.place)
            .and_then(|node| self.position(node));
        let approach = approach.map_or(Some(USUALLY_APPROACH), |node| {
            self.reader.number(node, (0.0, 10.0))
        });
        let shape = match shape {
            Some(node) => Some(skills::read_shape(node, self.reader)?),
            None => None,
        };
        Some(skills::Job {
            pick: pick?,
            place: place?,
            approach: approach?,
            shape,
        })
    }

    fn position(&mut self, node: &DocumentNode) -> Option<[f64; 6]> {
        let numbers: Vec<f64> = self.each(node, |reading, node| {
            reading.reader.number(node, (-1000.0, 1000.0))
        });
        numbers.try_into().ok().or_else(|| {
            self.reader.refuse(
                node,
                YamlFindingCode::WrongValue,
                "a position is six numbers: m, m, m, rad, rad, rad".to_owned(),
            )
        })
    }
}
