//! Runs an action: sends its goal, shows its feedback and waits for its result. Ctrl-C cancels the
//! goal.

use std::collections::VecDeque;
use std::hash::{BuildHasher as _, RandomState};
use std::sync::Arc;
use std::time::Duration;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;
use mappings::TopicId;
use serde::Serialize;
use uadp::action::{ActionOutcome, CallId, ResponseMeaning, Unknown};

use super::super::book::{DatagramContent, NameKind};
use super::super::described::AnnouncedDescription;
use super::super::plain::{self, NamedValues};
use super::super::{Go, ListenEnd, parameters, until};
use super::{Asking, LOOK, called, refused, words};
use crate::exit::CommandFailure;
use crate::report::warn;

/// The calls and the feedback topic of an action, besides the call that sends goals.
#[derive(Debug, Clone, Copy)]
pub(super) struct ActionParts {
    cancel: TopicId,
    result: TopicId,
    feedback: TopicId,
}

impl ActionParts {
    /// Returns the parts of an action; `None` for a call that does not send goals.
    pub(super) fn of(goal: TopicId, described: &AnnouncedDescription) -> Option<Self> {
        let action = described.call()?.action?;
        let (space, namespace, _) = goal.triple();
        let of = |id| TopicId::new(space, namespace, id);
        Some(Self {
            cancel: of(action.cancel)?,
            result: of(action.result)?,
            feedback: of(action.feedback)?,
        })
    }
}

/// An event of a goal.
#[derive(Debug, Serialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub(super) enum GoalUpdate {
    Feedback {
        fields: NamedValues,
    },
    Result {
        status: &'static str,
        message: String,
        fields: NamedValues,
    },
}

impl GoalUpdate {
    /// Returns the lines for people.
    pub(super) fn told(&self) -> String {
        match self {
            Self::Feedback { fields } => {
                let each = fields
                    .0
                    .iter()
                    .map(|(name, value)| format!("{name}: {value}"));
                each.collect::<Vec<_>>().join(", ")
            }
            Self::Result {
                status,
                message,
                fields,
            } => {
                let mut text = status.to_lowercase();
                if !message.is_empty() {
                    text.push_str(&format!(": {message}"));
                }
                for (name, value) in &fields.0 {
                    text.push_str(&format!("\n{name}: {value}"));
                }
                text
            }
        }
    }
}

/// A followed goal.
struct FollowedGoal {
    parts: ActionParts,
    /// The goal id as values show it.
    id: String,
    bytes: [u8; 16],
    result: Arc<AnnouncedDescription>,
    cancel: Arc<AnnouncedDescription>,
    /// The call that waits for the result.
    waits: CallId,
    cancelling: Option<Cancelling>,
}

/// The cancellation of a goal.
struct Cancelling {
    /// The requests without a response, oldest first.
    calls: VecDeque<CallId>,
    /// The time of the next request; a request may arrive before the goal, or get lost.
    again: Duration,
    /// The time limit for the end of the goal.
    until: Duration,
    is_refused: bool,
    /// The server has agreed to cancel the goal, and is not asked again.
    is_agreed: bool,
}

impl Cancelling {
    /// Records a response. Returns true if the server refuses the cancellation: servers also refuse
    /// a second request, so the refusal counts when no request was or may be agreed to.
    fn answered(&mut self, call: CallId, answer: CancelAnswer) -> bool {
        let Some(place) = self.calls.iter().position(|of| *of == call) else {
            return false;
        };
        self.calls.remove(place);
        match answer {
            CancelAnswer::Agreed => self.is_agreed = true,
            CancelAnswer::Refused if !self.is_agreed && self.calls.is_empty() => {
                return !std::mem::replace(&mut self.is_refused, true);
            }
            CancelAnswer::Refused | CancelAnswer::Other => {}
        }
        false
    }
}

/// The response of an executor to a cancel request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum CancelAnswer {
    Agreed,
    Refused,
    /// The goal is unknown or has ended, or there is no response.
    Other,
}

/// The outcome of the call that waits for the result.
enum Came {
    Result(NamedValues),
    /// The time limit passed without a response.
    Nothing,
    Failed(CommandFailure),
}

impl Asking<'_> {
    /// Sends a goal and, without `--no-wait`, follows it to its end.
    pub(super) async fn send_goal(
        &mut self,
        (topic, described): (TopicId, &AnnouncedDescription),
        parts: ActionParts,
    ) -> Result<(), CommandFailure> {
        let takes = described.call().map_or(&[][..], |call| &call.request);
        let takes = words::fields(takes);
        let fills = described.ros_type().is_some() && described.skill_type().is_none();
        let usage =
            |wrong: String| CommandFailure::Usage(format!("{}: {wrong}", called(topic, described)));
        let typed = words::spelled(&self.arguments.parameters, &takes, fills);
        let typed = typed.map_err(|wrong| usage(wrong.to_string()))?;
        let block =
            parameters::request(&typed, &takes).map_err(|wrong| usage(wrong.to_string()))?;
        let [result, cancel] = self.parts_of(topic, parts).await?;
        let bytes = new_id();
        let request = behind(bytes, &block).ok_or_else(|| usage("too many fields".to_owned()))?;
        let waiting = |waits| FollowedGoal {
            parts,
            id: BASE64.encode(bytes),
            bytes,
            result: Arc::clone(&result),
            cancel: Arc::clone(&cancel),
            waits,
            cancelling: None,
        };
        let of_result = (parts.result, &*result);
        let answer = match self.ask((topic, described), &request, None).await {
            // The goal may already be accepted, or be accepted later. Its result gives the end in
            // both cases.
            Err(failure @ (CommandFailure::Interrupted | CommandFailure::Unavailable(_))) => {
                if let CommandFailure::Unavailable(why) = &failure {
                    warn(why);
                }
                warn("cancelling the goal (Ctrl-C leaves at once)");
                let waits = self.begin(of_result, &behind_nothing(bytes), RESULT_WITHIN)?;
                let mut goal = waiting(waits);
                self.cancel_goal(&mut goal)?;
                let end = self.follow_goal(goal).await?;
                let is_lost = matches!(failure, CommandFailure::Unavailable(_));
                return if is_lost { end } else { Err(failure) };
            }
            answer => answer?,
        };
        self.tell_answer((topic, described), &answer)?;
        refused((topic, described), &answer)?;
        if answer.fields.get("accepted") != Some(&true.into()) {
            let why = answer.fields.text("message").unwrap_or_default();
            let why = if why.is_empty() {
                "no reason is given"
            } else {
                why
            };
            let name = called(topic, described);
            return Err(CommandFailure::Failed(format!(
                "{name}: the goal is rejected: {why}"
            )));
        }
        if self.arguments.no_wait {
            return Ok(());
        }
        let waits = self.begin(of_result, &behind_nothing(bytes), RESULT_WITHIN)?;
        self.follow_goal(waiting(waits)).await?
    }

    /// Waits for the announcements of the calls that return results and cancel goals.
    async fn parts_of(
        &mut self,
        goal: TopicId,
        parts: ActionParts,
    ) -> Result<[Arc<AnnouncedDescription>; 2], CommandFailure> {
        for topic in [parts.cancel, parts.result, parts.feedback] {
            self.live.want(topic);
        }
        let mut found: [Option<Arc<AnnouncedDescription>>; 2] = [None, None];
        let mut hears_feedback = false;
        let executor = self.executor;
        for (topic, kind, described, _) in self
            .live
            .book
            .announced_where(|from| executor.publishes(from))
        {
            take(&mut found, parts, (topic, kind), described);
            hears_feedback |= (topic, kind) == (parts.feedback, NameKind::Value);
        }
        let end = until(self.live.now(), Some(self.arguments.wait));
        let mut each = |news: DatagramContent<'_>, _| {
            if let DatagramContent::Announced {
                topic,
                kind,
                described,
                from,
                ..
            } = news
                && executor.publishes(from)
            {
                take(&mut found, parts, (topic, kind), described);
                hears_feedback |= (topic, kind) == (parts.feedback, NameKind::Value);
            }
            if found.iter().all(Option::is_some) && hears_feedback {
                Go::Enough
            } else {
                Go::On
            }
        };
        let ended = self.live.listen(end, &mut each).await?;
        match found {
            [Some(result), Some(cancel)] => Ok([result, cancel]),
            _ if ended == ListenEnd::Interrupted => Err(CommandFailure::Interrupted),
            _ => Err(CommandFailure::Unavailable(format!(
                "{goal} sends goals, and no program offers {} and {}, which belong to it",
                parts.result, parts.cancel
            ))),
        }
    }

    /// Waits for the end of a goal and returns it.
    ///
    /// # Errors
    /// The wait was interrupted or timed out, or the end of the goal is unknown.
    async fn follow_goal(
        &mut self,
        mut goal: FollowedGoal,
    ) -> Result<Result<(), CommandFailure>, CommandFailure> {
        let limit = until(self.live.now(), self.arguments.run_timeout);
        loop {
            let (ended, told, came) = self.hear_goal(&mut goal).await?;
            for told in &told {
                self.tell(told, &told.told())?;
            }
            match came {
                None => {}
                Some(Came::Result(fields)) => {
                    let end = self.end_goal(&fields)?;
                    self.acknowledge().await?;
                    return Ok(end);
                }
                Some(Came::Nothing) => {
                    let request = behind_nothing(goal.bytes);
                    let of = (goal.parts.result, &*goal.result);
                    goal.waits = self.begin(of, &request, RESULT_WITHIN)?;
                }
                Some(Came::Failed(failure)) => return Err(failure),
            }
            let now = self.live.now();
            match &goal.cancelling {
                Some(_) if ended == ListenEnd::Interrupted => {
                    warn(
                        "leaving: the goal may still be accepted or go on, and its outcome is unknown",
                    );
                    return Err(CommandFailure::Interrupted);
                }
                Some(cancelling) if cancelling.until <= now => {
                    return Err(CommandFailure::Unavailable(format!(
                        "the goal has not ended {} s after it was cancelled: its outcome is unknown",
                        ENDS_WITHIN.as_secs()
                    )));
                }
                Some(cancelling) if cancelling.again <= now && !cancelling.is_agreed => {
                    self.cancel_goal(&mut goal)?;
                }
                Some(_) => {}
                None => {
                    let is_over = now >= limit;
                    if is_over {
                        warn("the time for the goal is over");
                    }
                    if is_over || ended == ListenEnd::Interrupted {
                        warn("cancelling the goal (once more to leave at once)");
                        self.cancel_goal(&mut goal)?;
                    }
                }
            }
        }
    }

    /// Requests the cancellation of the goal. The goal is followed to its end for any response.
    fn cancel_goal(&mut self, goal: &mut FollowedGoal) -> Result<(), CommandFailure> {
        let request = cancel_request(&behind_nothing(goal.bytes));
        let cancel = Arc::clone(&goal.cancel);
        let call = self.begin((goal.parts.cancel, &cancel), &request, CANCEL_WITHIN)?;
        let now = self.live.now();
        let cancelling = goal.cancelling.get_or_insert_with(|| Cancelling {
            calls: VecDeque::new(),
            again: now,
            until: now + ENDS_WITHIN,
            is_refused: false,
            is_agreed: false,
        });
        cancelling.again = now + CANCEL_AGAIN;
        cancelling.calls.push_back(call);
        Ok(())
    }

    /// Listens for a moment to the feedback and result of a goal.
    async fn hear_goal(
        &mut self,
        goal: &mut FollowedGoal,
    ) -> Result<(ListenEnd, Vec<GoalUpdate>, Option<Came>), CommandFailure> {
        self.transmit()?;
        let Self {
            live,
            requestor,
            executor,
            ..
        } = self;
        let next = requestor.poll_timeout().unwrap_or(Duration::MAX);
        let next = next.min(live.now() + LOOK);
        let (mut told, mut came) = (Vec::new(), None);
        let mut each = |news: DatagramContent<'_>, now| {
            match &news {
                DatagramContent::Response(response, from) => {
                    if executor.answers(requestor, (response, *from))
                        && let Ok(ResponseMeaning::Done(call, outcome)) =
                            requestor.handle_response(response, now)
                    {
                        if call == goal.waits {
                            came = Some(hear(&outcome, &goal.result));
                        } else if let Some(cancelling) = &mut goal.cancelling
                            && cancelling.answered(call, cancel_answer(&outcome, &goal.cancel))
                        {
                            warn("the action server refuses to cancel the goal, which goes on");
                        }
                    }
                }
                DatagramContent::Sample(sample)
                    if sample.topic == goal.parts.feedback && executor.publishes(sample.from) =>
                {
                    let described = sample.described.as_deref();
                    if let Ok(value) = plain::message(&sample.message, described)
                        && value.text(words::GOAL_ID) == Some(&goal.id)
                    {
                        let fields = own(value, "feedback");
                        told.push(GoalUpdate::Feedback { fields });
                    }
                }
                DatagramContent::Sample(_) | DatagramContent::Announced { .. } => {}
            }
            if told.is_empty() && came.is_none() {
                Go::On
            } else {
                Go::Enough
            }
        };
        let ended = live.listen(next, &mut each).await?;
        requestor.handle_timeout(live.now());
        while let Some((call, why)) = requestor.poll_given_up() {
            if call == goal.waits && came.is_none() {
                came = Some(unknown(why));
            } else if let Some(cancelling) = &mut goal.cancelling {
                cancelling.answered(call, CancelAnswer::Other);
            }
        }
        Ok((ended, told, came))
    }

    /// Prints the result of a goal.
    fn end_goal(&self, fields: &NamedValues) -> Result<Result<(), CommandFailure>, CommandFailure> {
        let status = fields.get("status").and_then(serde_json::Value::as_i64);
        let status = match status {
            Some(4) => "SUCCEEDED",
            Some(5) => "CANCELED",
            Some(6) => "ABORTED",
            Some(-1) => "REJECTED",
            Some(_) | None => "UNKNOWN",
        };
        let message = fields.text("message").unwrap_or_default().to_owned();
        let mut rest = fields.clone();
        rest.0
            .retain(|(name, _)| name != "status" && name != "message");
        let texts = rest.0.iter();
        let texts = texts.filter_map(|(name, value)| Some((name.as_str(), value.as_str()?)));
        let said = Some(message.trim()).filter(|message| !message.is_empty());
        let why = said.or_else(|| messages::reason_of(texts));
        let why = why.map(|why| format!(": {why}")).unwrap_or_default();
        let told = GoalUpdate::Result {
            status,
            message,
            fields: own(rest, "result"),
        };
        self.tell(&told, &told.told())?;
        Ok(match status {
            "SUCCEEDED" => Ok(()),
            "UNKNOWN" => Err(CommandFailure::Unavailable(format!(
                "the executor of the action has lost the goal, and its outcome is unknown{why}"
            ))),
            _ => Err(CommandFailure::Failed(format!(
                "the goal was {}{why}",
                status.to_lowercase()
            ))),
        })
    }
}

fn take(
    found: &mut [Option<Arc<AnnouncedDescription>>; 2],
    parts: ActionParts,
    (topic, kind): (TopicId, NameKind),
    described: &Arc<AnnouncedDescription>,
) {
    let [result, cancel] = found;
    if kind == NameKind::Call && topic == parts.result {
        *result = Some(Arc::clone(described));
    } else if kind == NameKind::Call && topic == parts.cancel {
        *cancel = Some(Arc::clone(described));
    }
}

fn hear(outcome: &ActionOutcome<'_>, described: &AnnouncedDescription) -> Came {
    match outcome {
        ActionOutcome::Answered { status, fields } if status.0 & super::BAD == 0 => {
            match plain::response(*fields, described.fields()) {
                Ok(fields) => Came::Result(fields),
                Err(error) => Came::Failed(CommandFailure::Unavailable(format!(
                    "the result cannot be read: {error}"
                ))),
            }
        }
        ActionOutcome::Answered { status, .. } => {
            Came::Failed(CommandFailure::Unavailable(format!(
                "there is no result: {:#010x}; how the goal ended is not known",
                status.0
            )))
        }
        ActionOutcome::Refused(why) => Came::Failed(CommandFailure::Unavailable(format!(
            "the result is refused: {why}; the goal goes on"
        ))),
        ActionOutcome::Unknown(why) => unknown(*why),
    }
}

/// Reads the response to a cancel request.
fn cancel_answer(outcome: &ActionOutcome<'_>, cancel: &AnnouncedDescription) -> CancelAnswer {
    let ActionOutcome::Answered { status, fields } = outcome else {
        return CancelAnswer::Other;
    };
    let answer = plain::response(*fields, cancel.fields()).ok();
    let code = answer.and_then(|answer| {
        let code = answer.get("return_code")?;
        code.as_i64()
    });
    match code.filter(|_| status.0 & super::BAD == 0) {
        Some(AGREED) => CancelAnswer::Agreed,
        Some(REJECTED) => CancelAnswer::Refused,
        Some(_) | None => CancelAnswer::Other,
    }
}

fn unknown(why: Unknown) -> Came {
    if why == Unknown::Deadline {
        return Came::Nothing;
    }
    Came::Failed(CommandFailure::Unavailable(format!(
        "{why}; how the goal ended is not known"
    )))
}

/// Returns the fields of a part, by their names within the part.
fn own(value: NamedValues, part: &str) -> NamedValues {
    let fields = value.0.into_iter();
    let fields = fields.filter(|(name, _)| name != words::GOAL_ID);
    NamedValues(
        fields
            .map(|(name, value)| (words::own(&name, part).to_owned(), value))
            .collect(),
    )
}

fn new_id() -> [u8; 16] {
    let mut id = [0; 16];
    for place in id.chunks_exact_mut(8) {
        place.copy_from_slice(&RandomState::new().hash_one(0).to_le_bytes());
    }
    id
}

/// Prepends the goal id to the fields of a block; `None` if there are too many fields.
fn behind(id: [u8; 16], block: &[u8]) -> Option<Vec<u8>> {
    let (count, rest) = block.split_first_chunk()?;
    let count = u16::from_le_bytes(*count).checked_add(1)?;
    let mut whole = count.to_le_bytes().to_vec();
    whole.push(BYTE_STRING);
    whole.extend(16_i32.to_le_bytes());
    whole.extend(id);
    whole.extend(rest);
    Some(whole)
}

/// Returns a block with the goal id only.
fn behind_nothing(id: [u8; 16]) -> Vec<u8> {
    behind(id, &[0, 0]).unwrap_or_default()
}

/// Returns a block with the goal id and the start of 1970, which stands for no time.
fn cancel_request(of: &[u8]) -> Vec<u8> {
    let mut request = of.to_vec();
    if let Some(count) = request.first_mut() {
        *count = 2;
    }
    request.push(DATE_TIME);
    request.extend(UNIX_EPOCH.to_le_bytes());
    request
}

/// Time limit of a request for a result, which is repeated.
const RESULT_WITHIN: Duration = Duration::from_secs(30);
/// Time limit of a request to cancel.
const CANCEL_WITHIN: Duration = Duration::from_secs(5);
/// The interval of requests to cancel, until the goal has ended.
const CANCEL_AGAIN: Duration = Duration::from_secs(1);
/// Time limit for the end of a goal after its cancellation.
const ENDS_WITHIN: Duration = Duration::from_secs(60);
/// ERROR_NONE and ERROR_REJECTED of `action_msgs/CancelGoal`.
const AGREED: i64 = 0;
const REJECTED: i64 = 1;
/// EncodingMasks of OPC 10000-6, 5.2.2.16.
const BYTE_STRING: u8 = 15;
const DATE_TIME: u8 = 13;
/// The start of 1970 as a DateTime.
const UNIX_EPOCH: i64 = 116_444_736_000_000_000;

#[cfg(test)]
mod tests {
    use uadp::OwnedPublisherId;
    use uadp::action::{ActionAddress, ActionDialect, ActionFields, ActionRequest};

    use super::*;

    #[test]
    fn a_refusal_counts_when_no_other_request_was_agreed_to() {
        use CancelAnswer::{Agreed, Other, Refused};
        let mut requestor = super::super::requestor();
        let ids: Vec<CallId> = (0..10)
            .map(|_| {
                let request = ActionRequest {
                    address: ActionAddress {
                        publisher_id: OwnedPublisherId::UInt16(2),
                        writer_group_id: Some(2),
                        writer_id: 71,
                        target_id: 1,
                    },
                    dialect: ActionDialect::Standard,
                    fields: ActionFields::Variants(&[0, 0]),
                    timeout: CANCEL_WITHIN,
                };
                requestor.call(request, Duration::ZERO).unwrap()
            })
            .collect();
        let call = |number: usize| ids[number];
        let asked = |calls: &[usize]| Cancelling {
            calls: calls.iter().copied().map(call).collect(),
            again: Duration::ZERO,
            until: ENDS_WITHIN,
            is_refused: false,
            is_agreed: false,
        };
        // A server agrees to the first request and refuses the second, in either order of arrival.
        for order in [[(1, Agreed), (2, Refused)], [(2, Refused), (1, Agreed)]] {
            let mut cancelling = asked(&[1, 2]);
            for (id, answer) in order {
                assert!(!cancelling.answered(call(id), answer));
            }
            assert!(cancelling.is_agreed);
        }
        // A refusal of all requests is reported once.
        let mut cancelling = asked(&[1, 2, 3, 4]);
        let answers = [Refused, Other, Refused, Refused];
        let told = (1..).zip(answers);
        let told = told.map(|(id, answer)| cancelling.answered(call(id), answer));
        assert_eq!(told.collect::<Vec<_>>(), [false, false, false, true]);
        cancelling.calls.push_back(call(5));
        assert!(!cancelling.answered(call(5), Refused));
        // Responses to other calls do not count.
        assert!(!asked(&[1]).answered(call(9), Refused));
    }
}
