//! The order, the conditions and the time limit of a step of a sequence.

use skills::yaml::{DocumentKind, DocumentNode, YamlFindingCode};

use super::{Reading, plain, shortened};
use crate::process::{BadEnd, Compare, ProcessStep, StepCondition, Test};

impl Reading<'_, '_> {
    /// Reads the keys `after`, `when` and `within` of a step, which follows these steps.
    pub(super) fn flow(
        &mut self,
        step: &mut ProcessStep,
        [after, when, within]: [Option<&DocumentNode>; 3],
        earlier: &[ProcessStep],
    ) -> Option<()> {
        if let Some(node) = after {
            let mut numbers = match &node.kind {
                DocumentKind::Scalar(_) => vec![self.earlier(node, earlier)?],
                DocumentKind::List(_) | DocumentKind::Map(_) | DocumentKind::Null => {
                    let count = self.reader.list(node).len();
                    let read = self.each(node, |reading, node| reading.earlier(node, earlier));
                    (read.len() == count).then_some(read)?
                }
            };
            numbers.sort_unstable();
            numbers.dedup();
            step.after = Some(numbers);
        }
        if let Some(node) = when {
            let conditions = match &node.kind {
                DocumentKind::Map(_) => vec![self.condition(node, earlier)?],
                DocumentKind::List(_) | DocumentKind::Scalar(_) | DocumentKind::Null => {
                    let count = self.reader.list(node).len();
                    let read = self.each(node, |reading, node| reading.condition(node, earlier));
                    (read.len() == count).then_some(read)?
                }
            };
            step.when = vec![conditions];
        }
        if let Some(node) = within {
            step.within = Some(self.reader.duration(node)?);
        }
        Some(())
    }

    /// Reads a condition: a result of an earlier step, or its end.
    fn condition(&mut self, node: &DocumentNode, earlier: &[ProcessStep]) -> Option<StepCondition> {
        let keys = ["of", "result", "is", "ended", "not"];
        let [of, result, is, ended, not] = self.reader.map(node, keys)?;
        let of = self.reader.needed(of, "of", node.place)?;
        let step = self.earlier(of, earlier)?;
        let test = match ended {
            Some(end) => {
                if let Some(other) = result.or(is) {
                    let why = "a condition is about a result or about an end";
                    return self
                        .reader
                        .refuse(other, YamlFindingCode::WrongValue, why.to_owned());
                }
                Test::Ended(self.bad_end(end)?)
            }
            None => {
                let result = self.reader.needed(result, "result", node.place)?;
                let name = self.reader.text(result, "the name of a result")?.to_owned();
                let is = self.reader.needed(is, "is", node.place)?;
                let text = self
                    .reader
                    .text(is, "a value, as `true` or \"> 20\"")?
                    .trim();
                let mut signs = Compare::ALL.iter();
                let signed = signs.find_map(|(compare, sign)| {
                    let value = text.strip_prefix(sign)?;
                    Some((*compare, value.trim_start()))
                });
                let (compare, value) = signed.unwrap_or((Compare::Equal, text));
                Test::Result {
                    name,
                    compare,
                    value: plain(value),
                }
            }
        };
        let is_negated = match not {
            Some(not) => self.reader.boolean(not)?,
            None => false,
        };
        Some(StepCondition {
            step,
            test,
            is_negated,
        })
    }

    fn bad_end(&mut self, node: &DocumentNode) -> Option<BadEnd> {
        let text = self.reader.text(node, "failed or timed out")?;
        let all = [BadEnd::Failed, BadEnd::TimedOut];
        let found = all.into_iter().find(|end| end.name() == text);
        found.or_else(|| {
            let why = format!(
                "expected `failed` or `timed out`, found `{}`",
                shortened(text)
            );
            self.reader.refuse(node, YamlFindingCode::WrongValue, why)
        })
    }
}
