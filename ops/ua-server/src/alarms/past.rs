//! The history of the events of conditions (OPC 10000-11, 6.4.2): the last events, in memory.

use std::collections::VecDeque;

use opcua::nodes::{Event as _, ParsedEventFilter, TypeTree};
use opcua::server::ContinuationPoint;
use opcua::server::node_manager::HistoryNode;
use opcua::types::{
    EventFieldList, HistoryEvent, HistoryEventFieldList, ReadEventDetails, StatusCode,
};

use super::event::ConditionEvent;
use crate::history::{HistoryValue, MOST_EVENTS_RETURNED, given, steps};

/// The last events of all conditions, oldest first.
#[derive(Default)]
pub(super) struct PastEvents {
    events: VecDeque<(u64, ConditionEvent)>,
    next: u64,
}

/// The numbers of the events that follow in the next response.
struct Rest(Vec<u64>);

impl PastEvents {
    /// Stores an event.
    pub(super) fn keep(&mut self, event: ConditionEvent) {
        if self.events.len() >= MOST_EVENTS {
            self.events.pop_front();
        }
        self.events.push_back((self.next, event));
        self.next += 1;
    }

    /// Returns the events of a time range, with the fields and by the filter of the request.
    pub(super) fn read(
        &self,
        details: &ReadEventDetails,
        node: &mut HistoryNode,
        types: &dyn TypeTree,
    ) {
        let most = usize::try_from(details.num_values_per_node).unwrap_or(usize::MAX);
        let most = match most {
            0 => MOST_EVENTS_RETURNED,
            most => most.min(MOST_EVENTS_RETURNED),
        };
        let fields = details.filter.select_clauses.as_ref().map_or(0, Vec::len);
        let most = most.min((MOST_FIELDS / fields.max(1)).max(1));
        let (_, filter) = ParsedEventFilter::new(details.filter.clone(), types);
        let found = filter.and_then(|filter| self.found((details, most), node, (&filter, types)));
        let (found, rest) = match found {
            Ok(found) => found,
            Err(status) => {
                node.set_status(status);
                return;
            }
        };
        if !rest.is_empty() {
            let rest = ContinuationPoint::new(Box::new(Rest(rest)));
            node.set_next_continuation_point(Some(rest));
        }
        node.set_status(if found.is_empty() {
            StatusCode::GoodNoData
        } else {
            StatusCode::Good
        });
        let events = found.into_iter().map(|fields| HistoryEventFieldList {
            event_fields: fields.event_fields,
        });
        node.set_result(HistoryEvent {
            events: Some(events.collect()),
        });
    }

    /// Returns at most `most` events of a request, or of its continuation point, in the requested
    /// order. Also returns the numbers of the selected events that follow.
    fn found(
        &self,
        (details, most): (&ReadEventDetails, usize),
        node: &HistoryNode,
        (filter, types): (&ParsedEventFilter, &dyn TypeTree),
    ) -> Result<(Vec<EventFieldList>, Vec<u64>), StatusCode> {
        let numbers = match node.continuation_point() {
            Some(point) => {
                let rest: &Rest = point.get().ok_or(StatusCode::BadContinuationPointInvalid)?;
                rest.0.clone()
            }
            None => self.numbers(details)?,
        };
        let (mut found, mut rest) = (Vec::new(), Vec::new());
        for number in numbers {
            let at = self.events.partition_point(|(other, _)| *other < number);
            let event = self.events.get(at).filter(|(other, _)| *other == number);
            let selected = event.and_then(|(_, event)| filter.evaluate(event, 0, types));
            match selected {
                Some(fields) if found.len() < most => found.push(fields),
                Some(_) => rest.push(number),
                None => {}
            }
        }
        Ok((found, rest))
    }

    /// Returns the numbers of the events of a time range, in the requested order.
    fn numbers(&self, details: &ReadEventDetails) -> Result<Vec<u64>, StatusCode> {
        let span = (given(details.start_time), given(details.end_time));
        let events = self.events.iter();
        let mut all: Vec<(i64, u64)> = events
            .map(|(number, event)| (event.time().ticks(), *number))
            .collect();
        // The clock may have been set back.
        all.sort_by_key(|(time, _)| *time);
        let times: Vec<i64> = all.iter().map(|(time, _)| *time).collect();
        // The number of events is that of the events that the filter selects.
        let count = match span {
            (Some(_), Some(_)) => 0,
            _ if details.num_values_per_node == 0 => 0,
            _ => u32::MAX,
        };
        let steps = steps(&times, span, (count, false))?;
        let numbers = steps.into_iter().filter_map(|step| {
            let HistoryValue::Value(at) = step else {
                return None;
            };
            all.get(at).map(|(_, number)| *number)
        });
        Ok(numbers.collect())
    }
}

/// Largest number of stored events.
const MOST_EVENTS: usize = 5_000;
/// Largest number of fields of all events in a response.
const MOST_FIELDS: usize = 50_000;
