//! History of the values (OPC 10000-11): the last values of each variable, in memory and in a file,
//! raw and as aggregates (OPC 10000-13).

mod aggregate;
mod past;
mod store;

use std::collections::HashMap;
use std::sync::Arc;

use opcua::server::ContinuationPoint;
use opcua::server::address_space::AddressSpace;
use opcua::server::node_manager::HistoryNode;
use opcua::types::{
    AggregateConfiguration, DataValue, DateTime, HistoryData, NodeId, NumericRange, ObjectId,
    ReadAtTimeDetails, ReadProcessedDetails, ReadRawModifiedDetails, ReferenceTypeId, StatusCode,
    TimestampsToReturn, VariableId, Variant, VariantScalarTypeId, VariantTypeId,
};

use self::aggregate::{Aggregate, AggregateRules, IntervalOutcome, PastValue, Quality};
pub(crate) use self::past::Past;
pub(crate) use self::store::{HistoryFile, StoredConditions, StoredValue};
use crate::budget::{LARGEST, SMALL};
use crate::layout::TopicNode;
use crate::value;
use crate::values::{NodeView, ShownValue};

/// The past values of a node, in the order of their times.
pub(crate) struct Series {
    topic: Arc<TopicNode>,
    field: Option<usize>,
    shown: Vec<One>,
}

/// A past value.
struct One {
    time: i64,
    /// Unique number of the value.
    number: u64,
    shown: ShownValue,
}

/// A value of a response.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum HistoryValue {
    Value(usize),
    /// There is no value before or after that time.
    NoBound(i64),
}

/// The rest of a response. Values are referenced by number, so values dropped in the meantime are
/// missing in the rest.
struct Rest(Vec<Left>);

#[derive(Clone, Copy)]
enum Left {
    /// The value with that number.
    Value(u64),
    NoBound(i64),
}

/// Accounts for the bytes of the values of a response.
pub(crate) struct ResponseBudget<'a> {
    used: usize,
    /// Returns true if there is memory for a large value beside all other responses.
    large: &'a (dyn Fn(usize) -> bool + Send + Sync),
}

/// The result of adding a value to a response.
enum Fit {
    Fits,
    /// The response has its largest size.
    Full,
    /// The value alone is too large.
    Refused(StatusCode),
}

impl<'a> ResponseBudget<'a> {
    pub(crate) const fn new(large: &'a (dyn Fn(usize) -> bool + Send + Sync)) -> Self {
        Self { used: 0, large }
    }

    fn take(&mut self, weight: usize) -> Fit {
        if weight >= LARGEST {
            return Fit::Refused(StatusCode::BadResponseTooLarge);
        }
        if self.used > 0 && self.used + weight > MOST_WEIGHT {
            return Fit::Full;
        }
        if weight > SMALL && !(self.large)(weight) {
            return Fit::Refused(StatusCode::BadOutOfMemory);
        }
        self.used += weight;
        Fit::Fits
    }
}

impl Series {
    /// Creates the series of a node from the kept values of its topic.
    pub(crate) fn new(
        (topic, field): (Arc<TopicNode>, Option<usize>),
        kept: Vec<(u64, ShownValue)>,
    ) -> Self {
        let mut shown: Vec<One> = kept
            .into_iter()
            .map(|(number, shown)| One {
                time: time(&shown),
                number,
                shown,
            })
            .collect();
        // The sort is stable: values with the same time stay in the order of their arrival.
        shown.sort_by_key(|one| one.time);
        Self {
            topic,
            field,
            shown,
        }
    }

    fn view(&self, at: usize) -> Option<NodeView<'_>> {
        let one = self.shown.get(at)?;
        Some(one.shown.view(&self.topic, self.field))
    }

    /// Executes ReadRaw (OPC 10000-11, 6.4.3.2).
    pub(crate) fn raw(
        &self,
        details: &ReadRawModifiedDetails,
        node: &mut HistoryNode,
        (wanted, room): (TimestampsToReturn, &mut ResponseBudget<'_>),
    ) {
        let steps = match self.begun(details, node) {
            Ok(steps) => steps,
            Err(status) => {
                node.set_status(status);
                return;
            }
        };
        let most = usize::try_from(details.num_values_per_node).unwrap_or(usize::MAX);
        let most = match most {
            0 => MOST_VALUES,
            most => most.min(MOST_VALUES),
        };
        let range = node.index_range().clone();
        let values = self.values(&steps, (most, &range), (wanted, room));
        let rest: Vec<Left> = steps
            .iter()
            .skip(values.len())
            .filter_map(|step| match step {
                HistoryValue::Value(at) => self.shown.get(*at).map(|one| Left::Value(one.number)),
                HistoryValue::NoBound(time) => Some(Left::NoBound(*time)),
            })
            .collect();
        node.set_status(if steps.is_empty() {
            StatusCode::GoodNoData
        } else {
            StatusCode::Good
        });
        if !rest.is_empty() {
            let rest = ContinuationPoint::new(Box::new(Rest(rest)));
            node.set_next_continuation_point(Some(rest));
        }
        node.set_result(HistoryData {
            data_values: Some(values),
        });
    }

    /// Returns all steps of a request, or the remaining steps of a continuation point.
    fn begun(
        &self,
        details: &ReadRawModifiedDetails,
        node: &HistoryNode,
    ) -> Result<Vec<HistoryValue>, StatusCode> {
        if details.is_read_modified {
            return Err(StatusCode::BadHistoryOperationUnsupported);
        }
        let Some(point) = node.continuation_point() else {
            let times: Vec<i64> = self.shown.iter().map(|one| one.time).collect();
            let span = (given(details.start_time), given(details.end_time));
            return steps(
                &times,
                span,
                (details.num_values_per_node, details.return_bounds),
            );
        };
        let rest: &Rest = point.get().ok_or(StatusCode::BadContinuationPointInvalid)?;
        let numbers = self.shown.iter().enumerate();
        let places: HashMap<u64, usize> = numbers.map(|(at, one)| (one.number, at)).collect();
        let steps = rest.0.iter().filter_map(|left| match left {
            Left::Value(number) => places.get(number).map(|at| HistoryValue::Value(*at)),
            Left::NoBound(time) => Some(HistoryValue::NoBound(*time)),
        });
        Ok(steps.collect())
    }

    /// Returns the values of the first steps, as many as fit into a response.
    fn values(
        &self,
        steps: &[HistoryValue],
        (most, range): (usize, &NumericRange),
        (wanted, room): (TimestampsToReturn, &mut ResponseBudget<'_>),
    ) -> Vec<DataValue> {
        let mut values = Vec::new();
        for step in steps.iter().take(most) {
            let value = match step {
                HistoryValue::NoBound(time) => no_value(StatusCode::BadBoundNotFound, *time),
                HistoryValue::Value(at) => {
                    let Some(view) = self.view(*at) else {
                        break;
                    };
                    let (view, range) = view.narrowed(range);
                    match room.take(view.weight() + BESIDE) {
                        Fit::Fits => view.data_value(&range),
                        Fit::Refused(status) => view.refused(status),
                        Fit::Full => break,
                    }
                }
            };
            values.push(stamped(value, wanted));
        }
        values
    }

    /// Executes ReadProcessed (OPC 10000-11, 6.4.4) with the aggregate of that node.
    pub(crate) fn processed(
        &self,
        (details, kind): (&ReadProcessedDetails, &NodeId),
        node: &mut HistoryNode,
        (wanted, room): (TimestampsToReturn, &mut ResponseBudget<'_>),
    ) {
        let values = self.intervals(details, kind, room);
        answer(node, values, wanted);
    }

    fn intervals(
        &self,
        details: &ReadProcessedDetails,
        kind: &NodeId,
        room: &mut ResponseBudget<'_>,
    ) -> Result<Vec<DataValue>, StatusCode> {
        let aggregate = aggregate_of(kind).ok_or(StatusCode::BadAggregateNotSupported)?;
        let (start, end) = (given(details.start_time), given(details.end_time));
        let (Some(start), Some(end)) = (start, end) else {
            return Err(StatusCode::BadInvalidArgument);
        };
        let whole = end.abs_diff(start);
        let step = ticks(details.processing_interval).ok_or(StatusCode::BadInvalidArgument)?;
        let step = if step == 0 { whole } else { step };
        if whole == 0 || whole.div_ceil(step) > MOST_INTERVALS {
            return Err(StatusCode::BadInvalidArgument);
        }
        let rules = rules(&details.aggregate_configuration)?;
        let samples = self.samples();
        let mut values = Vec::new();
        let mut done = 0;
        while done < whole {
            let next = done.saturating_add(step).min(whole);
            let place = |part: u64| {
                if start <= end {
                    start.saturating_add_unsigned(part)
                } else {
                    start.saturating_sub_unsigned(part)
                }
            };
            let interval = (place(done), place(next));
            let outcome = aggregate::of(aggregate, &samples, interval, rules);
            let mut value = self.outcome(outcome, interval.0, room)?;
            let calculated = aggregate != Aggregate::Interpolative;
            if calculated && next - done < step {
                value.status = value.status.map(partial);
            }
            values.push(value);
            done = next;
        }
        Ok(values)
    }

    /// Executes ReadAtTime (OPC 10000-11, 6.4.5).
    pub(crate) fn at_times(
        &self,
        details: &ReadAtTimeDetails,
        node: &mut HistoryNode,
        (wanted, room): (TimestampsToReturn, &mut ResponseBudget<'_>),
    ) {
        let times = details.req_times.as_deref().unwrap_or_default();
        if times.is_empty() || times.len() > MOST_VALUES {
            node.set_status(StatusCode::BadInvalidArgument);
            return;
        }
        let samples = self.samples();
        let values = times.iter().map(|time| {
            let time = time.ticks();
            let outcome = aggregate::at(&samples, time, AggregateRules::default());
            self.outcome(outcome, time, room)
        });
        answer(node, values.collect(), wanted);
    }

    fn samples(&self) -> Vec<PastValue> {
        let samples = self.shown.iter().map(|one| {
            let view = one.shown.view(&self.topic, self.field);
            let status = view.stamp().status;
            PastValue {
                time: one.time,
                value: decoded(&view).and_then(|value| number(&value)),
                quality: if status.is_good() {
                    Quality::Good
                } else if status.is_uncertain() {
                    Quality::Uncertain
                } else {
                    Quality::Bad
                },
            }
        });
        samples.collect()
    }

    /// Converts the outcome of an aggregate into a value at the given time.
    ///
    /// # Errors
    /// Returns `BadResponseTooLarge` if the response has no space for the value.
    fn outcome(
        &self,
        outcome: IntervalOutcome,
        time: i64,
        room: &mut ResponseBudget<'_>,
    ) -> Result<DataValue, StatusCode> {
        let mut sample = |at: usize| {
            let Some(view) = self.view(at) else {
                return Ok(no_value(StatusCode::BadNoData, time));
            };
            match room.take(view.weight()) {
                Fit::Fits => Ok(view.data_value(&NumericRange::None)),
                Fit::Refused(status) => Ok(view.refused(status)),
                Fit::Full => Err(StatusCode::BadResponseTooLarge),
            }
        };
        let value = match outcome {
            IntervalOutcome::Raw(at) => sample(at)?,
            IntervalOutcome::Picked(at, quality) => {
                made(sample(at)?.value, (quality, CALCULATED), time)
            }
            IntervalOutcome::Actual(at, quality) => {
                let time = self.shown.get(at).map_or(time, |one| one.time);
                made(sample(at)?.value, (quality, RAW), time)
            }
            IntervalOutcome::Status(at) => {
                let status = self.view(at).map(|view| view.stamp().status);
                let value = status.map(Variant::StatusCode);
                made(value, (Quality::Good, CALCULATED), time)
            }
            IntervalOutcome::Held(at) => {
                made(sample(at)?.value, (Quality::Good, INTERPOLATED), time)
            }
            IntervalOutcome::Calculated(value, quality) => {
                made(Some(Variant::Double(value)), (quality, CALCULATED), time)
            }
            IntervalOutcome::Count(count, quality) => {
                let count = i32::try_from(count).unwrap_or(i32::MAX);
                made(Some(Variant::Int32(count)), (quality, CALCULATED), time)
            }
            IntervalOutcome::Interpolated(value, quality) => {
                let views = (0..self.shown.len()).filter_map(|at| self.view(at));
                let alike = views
                    .filter_map(|view| decoded(&view))
                    .find(|value| number(value).is_some());
                let value = like(value, alike.as_ref());
                made(Some(value), (quality, INTERPOLATED), time)
            }
            IntervalOutcome::NoData => no_value(StatusCode::BadNoData, time),
            IntervalOutcome::Bad => no_value(StatusCode::Bad, time),
        };
        match room.take(BESIDE) {
            Fit::Fits => Ok(value),
            Fit::Refused(_) | Fit::Full => Err(StatusCode::BadResponseTooLarge),
        }
    }
}

/// Sets the values or the error status of a node.
fn answer(
    node: &mut HistoryNode,
    values: Result<Vec<DataValue>, StatusCode>,
    wanted: TimestampsToReturn,
) {
    match values {
        Ok(values) => {
            node.set_status(StatusCode::Good);
            let values = values.into_iter().map(|value| stamped(value, wanted));
            node.set_result(HistoryData {
                data_values: Some(values.collect()),
            });
        }
        Err(status) => node.set_status(status),
    }
}

/// Builds the value of an interval. `how` is the historian bits of its status.
fn made(value: Option<Variant>, (quality, how): (Quality, u32), time: i64) -> DataValue {
    let base = match quality {
        Quality::Good => StatusCode::Good,
        Quality::Uncertain => StatusCode::UncertainDataSubNormal,
        Quality::Bad => StatusCode::Bad,
    };
    DataValue {
        value,
        ..no_value(StatusCode::from(base.bits() | how), time)
    }
}

/// Marks the value of an interval that is shorter than the others. A bad status stays unchanged.
fn partial(status: StatusCode) -> StatusCode {
    if status.is_bad() {
        status
    } else {
        StatusCode::from(status.bits() | PARTIAL)
    }
}

/// Decodes a value if it is small enough to be a number.
fn decoded(view: &NodeView<'_>) -> Option<Variant> {
    let small = view.weight() <= SMALL;
    small.then(|| view.data_value(&NumericRange::None).value)?
}

/// Returns the rules of a request.
///
/// # Errors
/// Returns `BadAggregateInvalidInputs` for percentages that contradict each other (OPC 10000-13,
/// 4.2.1.2).
fn rules(asked: &AggregateConfiguration) -> Result<AggregateRules, StatusCode> {
    if asked.use_server_capabilities_defaults {
        return Ok(AggregateRules::default());
    }
    let (bad, good) = (asked.percent_data_bad, asked.percent_data_good);
    if bad > 100 || good > 100 || u16::from(bad) + u16::from(good) < 100 {
        return Err(StatusCode::BadAggregateInvalidInputs);
    }
    Ok(AggregateRules {
        uncertain_is_bad: asked.treat_uncertain_as_bad,
        percent_bad: bad,
        percent_good: good,
    })
}

/// Returns the values of a span, without its end. The order is forward from the start, or backward
/// if the start is missing or later than the end. With bounds there is also a value at or before
/// the start and a value at or after the end (OPC 10000-11, 6.4.3.2).
pub(crate) fn steps(
    times: &[i64],
    (start, end): (Option<i64>, Option<i64>),
    (count, bounds): (u32, bool),
) -> Result<Vec<HistoryValue>, StatusCode> {
    let (start, end) = match (start, end) {
        (Some(start), Some(end)) => (start, Some(end)),
        (Some(start), None) if count > 0 => (start, None),
        (None, Some(end)) if count > 0 => return Ok(backwards(times, (end, None), bounds)),
        (Some(_) | None, None) | (None, Some(_)) => {
            return Err(StatusCode::BadHistoryOperationInvalid);
        }
    };
    if end.is_some_and(|end| end < start) {
        return Ok(backwards(times, (start, end), bounds));
    }
    let first = times.partition_point(|time| *time < start);
    let last = match end {
        Some(end) if end == start => times.partition_point(|time| *time <= end),
        Some(end) => times.partition_point(|time| *time < end),
        None => times.len(),
    };
    let mut steps = Vec::new();
    if bounds && times.get(first) != Some(&start) {
        steps.push(
            first
                .checked_sub(1)
                .map_or(HistoryValue::NoBound(start), HistoryValue::Value),
        );
    }
    steps.extend((first..last).map(HistoryValue::Value));
    if let Some(end) = end.filter(|end| bounds && *end != start) {
        let behind = (last < times.len()).then_some(HistoryValue::Value(last));
        steps.push(behind.unwrap_or(HistoryValue::NoBound(end)));
    }
    Ok(steps)
}

/// Returns the values from `start` backward to the earlier `end`.
fn backwards(times: &[i64], (start, end): (i64, Option<i64>), bounds: bool) -> Vec<HistoryValue> {
    let behind = times.partition_point(|time| *time <= start);
    let first = end.map_or(0, |end| times.partition_point(|time| *time <= end));
    let mut steps = Vec::new();
    if bounds && behind.checked_sub(1).and_then(|last| times.get(last)) != Some(&start) {
        let after = (behind < times.len()).then_some(HistoryValue::Value(behind));
        steps.push(after.unwrap_or(HistoryValue::NoBound(start)));
    }
    steps.extend((first..behind).rev().map(HistoryValue::Value));
    if let Some(end) = end.filter(|_| bounds) {
        steps.push(
            first
                .checked_sub(1)
                .map_or(HistoryValue::NoBound(end), HistoryValue::Value),
        );
    }
    steps
}

/// Returns the time of a value: its source timestamp, or else its time of arrival.
fn time(shown: &ShownValue) -> i64 {
    let source = shown.stamp.source;
    let time = source.map_or_else(
        || shown.stamp.server,
        |source| value::date_time(source.time),
    );
    time.ticks()
}

/// Returns a time, or `None` for a null time.
pub(crate) fn given(time: DateTime) -> Option<i64> {
    (time != DateTime::null()).then(|| time.ticks())
}

/// Converts a Duration into ticks of 100 ns. Returns `None` for an invalid Duration.
fn ticks(milliseconds: f64) -> Option<u64> {
    let time = std::time::Duration::try_from_secs_f64(milliseconds / 1e3).ok()?;
    u64::try_from(time.as_nanos() / 100).ok()
}

fn no_value(status: StatusCode, time: i64) -> DataValue {
    DataValue {
        value: None,
        status: Some(status),
        source_timestamp: Some(DateTime::from(time)),
        server_timestamp: Some(DateTime::now()),
        ..DataValue::default()
    }
}

/// Removes the timestamps that were not requested.
fn stamped(mut value: DataValue, wanted: TimestampsToReturn) -> DataValue {
    let both = wanted == TimestampsToReturn::Both;
    if !both && wanted != TimestampsToReturn::Source {
        value.source_timestamp = None;
    }
    if !both && wanted != TimestampsToReturn::Server {
        value.server_timestamp = None;
    }
    value
}

/// The aggregates by their nodes.
const AGGREGATES: [(ObjectId, Aggregate); 16] = [
    (
        ObjectId::AggregateFunction_Interpolative,
        Aggregate::Interpolative,
    ),
    (ObjectId::AggregateFunction_Average, Aggregate::Average),
    (ObjectId::AggregateFunction_Minimum, Aggregate::Minimum),
    (ObjectId::AggregateFunction_Maximum, Aggregate::Maximum),
    (ObjectId::AggregateFunction_Count, Aggregate::Count),
    (
        ObjectId::AggregateFunction_MinimumActualTime,
        Aggregate::MinimumActualTime,
    ),
    (
        ObjectId::AggregateFunction_MaximumActualTime,
        Aggregate::MaximumActualTime,
    ),
    (ObjectId::AggregateFunction_Range, Aggregate::Range),
    (ObjectId::AggregateFunction_Start, Aggregate::Start),
    (ObjectId::AggregateFunction_End, Aggregate::End),
    (ObjectId::AggregateFunction_Delta, Aggregate::Delta),
    (
        ObjectId::AggregateFunction_TimeAverage,
        Aggregate::TimeAverage,
    ),
    (ObjectId::AggregateFunction_Total, Aggregate::Total),
    (
        ObjectId::AggregateFunction_DurationGood,
        Aggregate::DurationGood,
    ),
    (
        ObjectId::AggregateFunction_PercentGood,
        Aggregate::PercentGood,
    ),
    (
        ObjectId::AggregateFunction_WorstQuality,
        Aggregate::WorstQuality,
    ),
];

/// Adds the aggregates to the folders in which clients look for them.
pub(crate) fn list_aggregates(core: &mut AddressSpace) {
    let folders = [
        ObjectId::HistoryServerCapabilities_AggregateFunctions,
        ObjectId::Server_ServerCapabilities_AggregateFunctions,
    ];
    for folder in folders {
        for (aggregate, _) in AGGREGATES {
            core.insert_reference(
                &folder.into(),
                &aggregate.into(),
                ReferenceTypeId::Organizes,
            );
        }
    }
}

/// Returns the history capabilities of the server.
pub(crate) fn capabilities() -> Vec<(VariableId, Variant)> {
    let most = u32::try_from(MOST_VALUES).unwrap_or(u32::MAX);
    let events = u32::try_from(MOST_EVENTS_RETURNED).unwrap_or(u32::MAX);
    vec![
        (
            VariableId::HistoryServerCapabilities_AccessHistoryDataCapability,
            true.into(),
        ),
        (
            VariableId::HistoryServerCapabilities_MaxReturnDataValues,
            most.into(),
        ),
        (
            VariableId::HistoryServerCapabilities_AccessHistoryEventsCapability,
            true.into(),
        ),
        (
            VariableId::HistoryServerCapabilities_MaxReturnEventValues,
            events.into(),
        ),
        (
            VariableId::HistoryServerCapabilities_ServerTimestampSupported,
            true.into(),
        ),
    ]
}

fn aggregate_of(kind: &NodeId) -> Option<Aggregate> {
    AGGREGATES
        .into_iter()
        .find(|(id, _)| *kind == *id)
        .map(|(_, aggregate)| aggregate)
}

fn number(value: &Variant) -> Option<f64> {
    if matches!(value, Variant::String(_) | Variant::Boolean(_)) {
        return None;
    }
    let double = VariantTypeId::Scalar(VariantScalarTypeId::Double);
    if let Variant::Double(number) = value.cast(double) {
        Some(number)
    } else {
        None
    }
}

/// Converts a number to the type of `others`, if it fits.
fn like(number: f64, others: Option<&Variant>) -> Variant {
    let given = Variant::Double(number);
    match others.map(Variant::type_id) {
        Some(VariantTypeId::Scalar(VariantScalarTypeId::Double)) | None => given,
        Some(VariantTypeId::Scalar(VariantScalarTypeId::Float)) => {
            given.cast(VariantTypeId::Scalar(VariantScalarTypeId::Float))
        }
        Some(kind) => {
            let cast = Variant::Double(number.round()).cast(kind);
            if matches!(cast, Variant::Empty) {
                given
            } else {
                cast
            }
        }
    }
}

/// InfoType DataValue with the bits of a historian (OPC 10000-4, 7.39.1).
const RAW: u32 = 0x0400;
const CALCULATED: u32 = 0x0401;
const INTERPOLATED: u32 = 0x0402;
const PARTIAL: u32 = 0x0404;
/// Size of a value of a response in addition to its data, in bytes.
const BESIDE: usize = size_of::<DataValue>();
/// Largest number of values in a response.
const MOST_VALUES: usize = 10_000;
const MOST_INTERVALS: u64 = 10_000;
/// Largest size of the values in a response, in bytes.
const MOST_WEIGHT: usize = 16 << 20;

/// Largest number of events in a response.
pub(crate) const MOST_EVENTS_RETURNED: usize = 1_000;

#[cfg(test)]
mod tests;
