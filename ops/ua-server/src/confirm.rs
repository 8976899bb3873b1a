//! Writes that succeed when the robot answers (`confirm:` in the mapping).
//!
//! A topic never has two pending writes. The write is registered before the value is sent, so that
//! no answer is missed. Without an answer the value counts as not written: it is not shown, and it
//! is not repeated to late joiners.

use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;
use std::time::Duration;

use mappings::{ConfirmingValues, Mapping, TopicId};
use opcua::sync::{Mutex, RwLock};
use opcua::types::{StatusCode, Variant};
use tokio::sync::{Notify, oneshot};

use crate::arrivals::Arrivals;
use crate::value;
use crate::values::ShownValue;

/// The rules of the mapping, and the pending writes.
#[derive(Default)]
pub(crate) struct Confirms {
    rules: RwLock<HashMap<TopicId, Arc<Rule>>>,
    waiting: Mutex<Waiting>,
    /// Topics with an unconfirmed last value, until the run loop has handled them.
    taken_back: Mutex<BTreeSet<TopicId>>,
    called: Notify,
    /// The writes that bridges confirm.
    pub(crate) arrivals: Arrivals,
}

/// The confirmation rule for the writes of a topic.
pub(crate) struct Rule {
    by: TopicId,
    within: Duration,
    answer: ConfirmingValues,
    /// Serializes the writes of the topic.
    turn: tokio::sync::Mutex<()>,
}

#[derive(Default)]
struct Waiting {
    next: u64,
    /// The pending writes by the topic that answers.
    writes: HashMap<TopicId, Vec<Write>>,
}

struct Write {
    number: u64,
    rule: Arc<Rule>,
    fields: Vec<Variant>,
    confirmed: oneshot::Sender<()>,
}

/// A pending write. Dropping it unregisters the write.
struct Pending<'c> {
    confirms: &'c Confirms,
    topic: TopicId,
    by: TopicId,
    number: u64,
    is_confirmed: bool,
}

impl Confirms {
    /// Sets the rules of a mapping. Unchanged rules are kept, with the writes that wait for their
    /// turn.
    pub(crate) fn follow(&self, mapping: &Mapping) {
        self.arrivals.follow(mapping);
        let mut rules = self.rules.write();
        let variables = mapping.variables().iter();
        let wanted = variables.filter_map(|variable| {
            let confirm = variable.confirm.as_deref()?;
            let known = rules.get(&variable.topic);
            let rule = known.filter(|rule| rule.is(confirm)).cloned();
            let rule = rule.unwrap_or_else(|| Arc::new(Rule::new(confirm)));
            Some((variable.topic, rule))
        });
        *rules = wanted.collect();
    }

    /// Returns the confirmation rule of a topic, or `None` if it has no rule.
    pub(crate) fn of(&self, topic: TopicId) -> Option<Arc<Rule>> {
        self.rules.read().get(&topic).cloned()
    }

    /// Writes a value and waits for its answer. `send` computes the fields, passes them to its
    /// argument and sends them. The result of `send` is returned when the answer has arrived.
    ///
    /// # Errors
    /// Returns the errors of `send`, and `BadTimeout` without an answer in time.
    pub(crate) async fn write<T: Send>(
        &self,
        topic: TopicId,
        rule: &Arc<Rule>,
        send: impl FnOnce(&dyn Fn(&[Variant])) -> Result<T, StatusCode> + Send,
    ) -> Result<T, StatusCode> {
        let deadline = tokio::time::Instant::now() + rule.within;
        let in_time = |_| StatusCode::BadTimeout;
        let turn = tokio::time::timeout_at(deadline, rule.turn.lock());
        let _turn = turn.await.map_err(in_time)?;
        let (pending, sent, answered) = self.begin(topic, rule, send)?;
        let deadline = tokio::time::Instant::now() + rule.within;
        match tokio::time::timeout_at(deadline, answered).await {
            Ok(Ok(())) => {
                pending.confirmed();
                Ok(sent)
            }
            Ok(Err(_)) | Err(_) => Err(StatusCode::BadTimeout),
        }
    }

    fn begin<T>(
        &self,
        topic: TopicId,
        rule: &Arc<Rule>,
        send: impl FnOnce(&dyn Fn(&[Variant])) -> Result<T, StatusCode>,
    ) -> Result<(Pending<'_>, T, oneshot::Receiver<()>), StatusCode> {
        let (confirmed, answered) = oneshot::channel();
        let number = {
            let mut waiting = self.waiting.lock();
            waiting.next += 1;
            waiting.next
        };
        let slot = Mutex::new(Some(confirmed));
        let register = |fields: &[Variant]| {
            if let Some(confirmed) = slot.lock().take() {
                let write = Write {
                    number,
                    rule: Arc::clone(rule),
                    fields: fields.to_vec(),
                    confirmed,
                };
                let mut waiting = self.waiting.lock();
                waiting.writes.entry(rule.by).or_default().push(write);
            }
        };
        let mut pending = Pending {
            confirms: self,
            topic,
            by: rule.by,
            number,
            // Nothing was sent yet.
            is_confirmed: true,
        };
        let sent = send(&register)?;
        pending.is_confirmed = false;
        Ok((pending, sent, answered))
    }

    /// Checks if a received value answers a pending write.
    pub(crate) fn heard(&self, topic: TopicId, shown: &ShownValue) {
        let mut waiting = self.waiting.lock();
        let Some(writes) = waiting.writes.get_mut(&topic) else {
            return;
        };
        let Some(fields) = shown.fields().filter(|_| !shown.stamp.status.is_bad()) else {
            return;
        };
        let fields: Vec<Variant> = fields
            .flatten()
            .map(|field| value::from_field(&field))
            .collect();
        let answered = writes.extract_if(.., |write| write.rule.is_answer(&write.fields, &fields));
        for write in answered {
            // The waiting client may be lost.
            let _gone = write.confirmed.send(());
        }
        if writes.is_empty() {
            waiting.writes.remove(&topic);
        }
    }

    /// Waits until a value was not confirmed.
    pub(crate) async fn called(&self) {
        self.called.notified().await;
    }

    /// Takes the topics with an unconfirmed last value.
    pub(crate) fn take_back(&self) -> BTreeSet<TopicId> {
        std::mem::take(&mut *self.taken_back.lock())
    }

    /// Records that a newer value replaces an unconfirmed value.
    pub(crate) fn supersede(&self, topic: TopicId) {
        self.taken_back.lock().remove(&topic);
    }
}

impl Rule {
    fn new(confirm: &mappings::Confirm) -> Self {
        Self {
            by: confirm.by,
            within: confirm.within,
            answer: confirm.answer.clone(),
            turn: tokio::sync::Mutex::new(()),
        }
    }

    fn is(&self, confirm: &mappings::Confirm) -> bool {
        (self.by, self.within, &self.answer) == (confirm.by, confirm.within, &confirm.answer)
    }

    fn is_answer(&self, written: &[Variant], answer: &[Variant]) -> bool {
        match &self.answer {
            ConfirmingValues::Any => true,
            ConfirmingValues::Same => {
                let pairs = written.iter().zip(answer);
                written.len() == answer.len()
                    && pairs.into_iter().all(|(one, other)| are_equal(one, other))
            }
            ConfirmingValues::Equals(text) => match answer {
                [only] => is_text(only, text),
                _ => false,
            },
        }
    }
}

/// Returns true if two values are equal within the precision of their types.
fn are_equal(one: &Variant, other: &Variant) -> bool {
    if let (Variant::Array(ones), Variant::Array(others)) = (one, other) {
        let pairs = ones.values.iter().zip(&others.values);
        return ones.values.len() == others.values.len()
            && pairs.into_iter().all(|(one, other)| are_equal(one, other));
    }
    if one == other {
        return true;
    }
    let (Some(first), Some(second)) = (one.as_f64(), other.as_f64()) else {
        return false;
    };
    let is_float = |value: &Variant| matches!(value, Variant::Float(_));
    let least = if is_float(one) || is_float(other) {
        f64::from(f32::EPSILON) * first.abs().max(second.abs())
    } else {
        0.0
    };
    (first - second).abs() <= least
}

/// Returns true if a value equals the value that the text denotes.
fn is_text(value: &Variant, text: &str) -> bool {
    if let Variant::Boolean(value) = value {
        return text.parse() == Ok(*value);
    }
    if let Variant::String(value) = value {
        return value.as_ref() == text;
    }
    let wanted = text.parse::<f64>().ok();
    wanted.is_some_and(|wanted| are_equal(value, &Variant::Double(wanted)))
}

impl Pending<'_> {
    fn confirmed(mut self) {
        self.is_confirmed = true;
    }
}

impl Drop for Pending<'_> {
    fn drop(&mut self) {
        let mut waiting = self.confirms.waiting.lock();
        if let Some(writes) = waiting.writes.get_mut(&self.by) {
            writes.retain(|write| write.number != self.number);
            if writes.is_empty() {
                waiting.writes.remove(&self.by);
            }
        }
        drop(waiting);
        if !self.is_confirmed {
            self.confirms.taken_back.lock().insert(self.topic);
            self.confirms.called.notify_one();
        }
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;

    use super::*;

    const WITHIN: Duration = Duration::from_millis(50);

    fn topic(identifier: u16) -> TopicId {
        TopicId::new(1, 2, identifier).unwrap()
    }

    fn rule(answer: ConfirmingValues) -> Arc<Rule> {
        Arc::new(Rule::new(&mappings::Confirm {
            by: topic(31),
            within: WITHIN,
            answer,
        }))
    }

    fn shown(value: Variant, status: StatusCode) -> ShownValue {
        let mut shown = ShownValue::nothing(status);
        shown.block = Some(Bytes::from(value::fields_block(&[value]).unwrap()));
        shown
    }

    /// Writes 2.5 with these answers and returns the result.
    async fn written(
        answer: ConfirmingValues,
        answers: &[ShownValue],
    ) -> (Result<u8, StatusCode>, Confirms) {
        let confirms = Confirms::default();
        let rule = rule(answer);
        let done = confirms.write(topic(30), &rule, |register| {
            register(&[Variant::from(2.5)]);
            for shown in answers {
                confirms.heard(topic(31), shown);
            }
            Ok(7)
        });
        let done = done.await;
        (done, confirms)
    }

    #[tokio::test]
    async fn the_answer_that_counts_confirms_and_no_other_does() {
        let good = |value: Variant| shown(value, StatusCode::Good);
        let same = || ConfirmingValues::Same;
        let equals = |text: &str| ConfirmingValues::Equals(text.to_owned());
        for (answer, came, wanted) in [
            (same(), vec![good(2.5.into())], true),
            (same(), vec![good(2.5_f32.into())], true),
            (same(), vec![good(1.0.into()), good(2.5.into())], true),
            (same(), vec![good(1.0.into())], false),
            (same(), vec![shown(2.5.into(), StatusCode::Bad)], false),
            (same(), vec![], false),
            (ConfirmingValues::Any, vec![good(9_i32.into())], true),
            (equals("true"), vec![good(true.into())], true),
            (equals("true"), vec![good(false.into())], false),
            (equals("3"), vec![good(3_i32.into())], true),
            (equals("done"), vec![good("done".into())], true),
            (equals("done"), vec![good("failed".into())], false),
        ] {
            let (done, confirms) = written(answer.clone(), &came).await;
            let told = format!("{answer:?} {came:?}");
            assert_eq!(done.is_ok(), wanted, "{told}");
            assert_eq!(confirms.take_back().is_empty(), wanted, "{told}");
            assert!(confirms.waiting.lock().writes.is_empty(), "{told}");
        }
    }

    #[tokio::test]
    async fn what_could_not_be_sent_is_not_taken_back() {
        let confirms = Confirms::default();
        let rule = rule(ConfirmingValues::Any);
        let refused = confirms.write(topic(30), &rule, |_| {
            Err::<(), _>(StatusCode::BadTypeMismatch)
        });
        assert_eq!(refused.await, Err(StatusCode::BadTypeMismatch));
        assert!(confirms.take_back().is_empty());
    }

    #[tokio::test]
    async fn of_two_writes_at_once_the_second_waits_for_its_turn_and_then_for_its_own_answer() {
        let confirms = Confirms::default();
        let rule = rule(ConfirmingValues::Same);
        let write = |value: f64| {
            confirms.write(topic(30), &rule, move |register| {
                register(&[Variant::from(value)]);
                Ok(value)
            })
        };
        let answers = async {
            confirms.heard(topic(31), &shown(2.0.into(), StatusCode::Good));
            confirms.heard(topic(31), &shown(1.0.into(), StatusCode::Good));
        };
        let (first, second, ()) = tokio::join!(write(1.0), write(2.0), answers);
        assert_eq!(first, Ok(1.0));
        assert_eq!(
            second,
            Err(StatusCode::BadTimeout),
            "it was answered before it was sent"
        );
    }
}
