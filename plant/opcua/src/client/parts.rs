//! Splits requests into parts that a server accepts.
//!
//! The OperationLimits of a server limit the number of operations in a request (OPC 10000-5,
//! 6.3.11). If a server answers BadTooManyOperations, the request is sent again in halves, and the
//! smaller size applies to the rest of the connection.

use std::sync::atomic::{AtomicUsize, Ordering};

use opcua::types::{DataValue, Error, StatusCode, VariableId, Variant};

use crate::limits::MOST_PER_REQUEST;

/// The services that have an OperationLimit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LimitedService {
    /// Read.
    Read,
    /// Write.
    Write,
    /// Browse and BrowseNext.
    Browse,
    /// CreateMonitoredItems.
    MonitoredItems,
}

impl LimitedService {
    const ALL: [Self; 4] = [Self::Read, Self::Write, Self::Browse, Self::MonitoredItems];

    const fn index(self) -> usize {
        match self {
            Self::Read => 0,
            Self::Write => 1,
            Self::Browse => 2,
            Self::MonitoredItems => 3,
        }
    }

    /// Returns whether the status means that the request was too large and that no operation was
    /// executed.
    fn is_too_large(self, status: StatusCode) -> bool {
        match status {
            StatusCode::BadTooManyOperations | StatusCode::BadRequestTooLarge => true,
            StatusCode::BadTooManyMonitoredItems => self == Self::MonitoredItems,
            // A Write may have been executed although its response was too large.
            StatusCode::BadResponseTooLarge | StatusCode::BadEncodingLimitsExceeded => {
                matches!(self, Self::Read | Self::Browse)
            }
            _ => false,
        }
    }
}

/// The maximum number of operations per request that a server accepts, for each service.
#[derive(Debug)]
pub struct OperationLimits([AtomicUsize; 4]);

impl Default for OperationLimits {
    fn default() -> Self {
        Self(LimitedService::ALL.map(|_| AtomicUsize::new(MOST_PER_REQUEST)))
    }
}

impl OperationLimits {
    /// The variables whose values are the argument of [`learn`](Self::learn), in this order.
    pub const VARIABLES: [VariableId; 4] = [
        VariableId::Server_ServerCapabilities_OperationLimits_MaxNodesPerRead,
        VariableId::Server_ServerCapabilities_OperationLimits_MaxNodesPerWrite,
        VariableId::Server_ServerCapabilities_OperationLimits_MaxNodesPerBrowse,
        VariableId::Server_ServerCapabilities_OperationLimits_MaxMonitoredItemsPerCall,
    ];

    /// Adopts the limits of a server. A missing value and 0 mean no limit.
    pub fn learn(&self, values: &[DataValue]) {
        for (service, value) in LimitedService::ALL.into_iter().zip(values) {
            if let Some(Variant::UInt32(most)) = value.value
                && most > 0
            {
                self.lower(service, usize::try_from(most).unwrap_or(usize::MAX));
            }
        }
    }

    /// Returns the largest number of operations for a request.
    #[must_use]
    pub fn most(&self, service: LimitedService) -> usize {
        let most = self.0.get(service.index());
        most.map_or(1, |most| most.load(Ordering::Relaxed))
    }

    fn lower(&self, service: LimitedService, most: usize) {
        if let Some(limit) = self.0.get(service.index()) {
            limit.fetch_min(most.max(1), Ordering::Relaxed);
        }
    }

    /// Splits a request into parts.
    #[must_use]
    pub fn parts<'l, 'q, Q, A>(
        &'l self,
        service: LimitedService,
        questions: &'q [Q],
    ) -> PartedRequest<'l, 'q, Q, A> {
        PartedRequest {
            limits: self,
            service,
            rest: questions,
            most: usize::MAX,
            sent: 0,
            answers: Vec::with_capacity(questions.len()),
        }
    }
}

/// A request that is sent in parts, and the results so far.
#[derive(Debug)]
pub struct PartedRequest<'l, 'q, Q, A> {
    limits: &'l OperationLimits,
    service: LimitedService,
    rest: &'q [Q],
    /// The maximum number of operations in a part of this request, if smaller than the limit of the
    /// connection.
    most: usize,
    /// The length of the part that was sent last.
    sent: usize,
    answers: Vec<A>,
}

/// A part failed.
#[derive(Debug)]
pub enum PartFault {
    /// The request failed.
    Failed(Error),
    /// The response has a wrong number of results.
    Short,
}

impl<'q, Q, A> PartedRequest<'_, 'q, Q, A> {
    /// Returns the next part to send, or `None` if all operations have results.
    pub fn next_part(&mut self) -> Option<&'q [Q]> {
        let most = self.limits.most(self.service).min(self.most);
        self.sent = most.min(self.rest.len());
        self.rest.get(..self.sent).filter(|part| !part.is_empty())
    }

    /// Stores the response to the last part. A part that was too large for the server is repeated
    /// in smaller parts.
    ///
    /// # Errors
    /// Returns an error if the request failed or if its response has a wrong number of results. The
    /// part is repeated unless [`skip`](Self::skip) is called.
    pub fn answered(&mut self, answer: Result<Vec<A>, Error>) -> Result<(), PartFault> {
        match answer {
            Ok(answers) if answers.len() == self.sent => {
                self.answers.extend(answers);
                self.rest = self.rest.get(self.sent..).unwrap_or_default();
                Ok(())
            }
            Ok(_) => Err(PartFault::Short),
            Err(error) if self.sent > 1 && self.service.is_too_large(error.status()) => {
                self.most = self.sent / 2;
                // The limit of a full subscription does not apply to the next subscription.
                if error.status() != StatusCode::BadTooManyMonitoredItems {
                    self.limits.lower(self.service, self.most);
                }
                Ok(())
            }
            Err(error) => Err(PartFault::Failed(error)),
        }
    }

    /// Uses the same result for each operation of the last part.
    pub fn skip(&mut self, answer: &A)
    where
        A: Clone,
    {
        self.answers
            .extend(std::iter::repeat_n(answer.clone(), self.sent));
        self.rest = self.rest.get(self.sent..).unwrap_or_default();
    }

    /// Uses the same result for each operation that has no result yet.
    pub fn skip_all(&mut self, answer: &A)
    where
        A: Clone,
    {
        self.sent = self.rest.len();
        self.skip(answer);
    }

    /// Returns the results, in the order of the operations.
    #[must_use]
    pub fn into_answers(self) -> Vec<A> {
        self.answers
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A server that accepts at most `most` operations and answers each operation with its number.
    struct Server {
        most: usize,
        status: StatusCode,
        sizes: Vec<usize>,
    }

    impl Server {
        fn ask(&mut self, part: &[usize]) -> Result<Vec<usize>, Error> {
            self.sizes.push(part.len());
            match part.len() <= self.most {
                true => Ok(part.to_vec()),
                false => Err(Error::new(self.status, "too many")),
            }
        }
    }

    fn ask(
        limits: &OperationLimits,
        service: LimitedService,
        count: usize,
        server: &mut Server,
    ) -> (Vec<usize>, Result<(), PartFault>) {
        let questions: Vec<usize> = (0..count).collect();
        let mut parts = limits.parts(service, &questions);
        let mut ended = Ok(());
        while let Some(part) = parts.next_part() {
            ended = parts.answered(server.ask(part));
            if ended.is_err() {
                break;
            }
        }
        (parts.into_answers(), ended)
    }

    fn server(most: usize, status: StatusCode) -> Server {
        Server {
            most,
            status,
            sizes: Vec::new(),
        }
    }

    #[test]
    fn limits_that_a_server_names_are_kept_from_the_first_request_on() {
        let limits = OperationLimits::default();
        let named = |most: u32| DataValue::from(Variant::UInt32(most));
        limits.learn(&[named(10), DataValue::null(), named(0), named(7)]);
        let all = LimitedService::ALL.map(|service| limits.most(service));
        assert_eq!(all, [10, MOST_PER_REQUEST, MOST_PER_REQUEST, 7]);
        let mut plc = server(10, StatusCode::BadTooManyOperations);
        let (answers, ended) = ask(&limits, LimitedService::Read, 25, &mut plc);
        ended.unwrap();
        assert_eq!(answers, (0..25).collect::<Vec<_>>());
        assert_eq!(plc.sizes, [10, 10, 5]);
    }

    #[test]
    fn limits_that_a_server_does_not_name_are_found_and_remembered() {
        let limits = OperationLimits::default();
        let mut plc = server(10, StatusCode::BadTooManyOperations);
        let (answers, ended) = ask(&limits, LimitedService::Write, 40, &mut plc);
        ended.unwrap();
        assert_eq!(answers, (0..40).collect::<Vec<_>>());
        assert_eq!(plc.sizes, [40, 20, 10, 10, 10, 10]);
        plc.sizes.clear();
        drop(ask(&limits, LimitedService::Write, 15, &mut plc));
        assert_eq!(plc.sizes, [10, 5]);
        assert_eq!(limits.most(LimitedService::Read), MOST_PER_REQUEST);
    }

    #[test]
    fn a_full_subscription_does_not_lower_the_limit_of_the_connection() {
        let limits = OperationLimits::default();
        let mut plc = server(25, StatusCode::BadTooManyMonitoredItems);
        let (answers, ended) = ask(&limits, LimitedService::MonitoredItems, 60, &mut plc);
        ended.unwrap();
        assert_eq!(answers.len(), 60);
        assert_eq!(
            limits.most(LimitedService::MonitoredItems),
            MOST_PER_REQUEST
        );
        // For a Read request this status does not mean that the request was too large.
        let mut plc = server(25, StatusCode::BadTooManyMonitoredItems);
        let (_, ended) = ask(&limits, LimitedService::Read, 60, &mut plc);
        assert!(matches!(ended, Err(PartFault::Failed(_))));
    }

    #[test]
    fn answers_before_a_failure_are_kept_and_writes_are_never_repeated_after_one() {
        let limits = OperationLimits::default();
        limits.learn(&[DataValue::null(), DataValue::from(Variant::UInt32(10))]);
        let questions: Vec<usize> = (0..25).collect();
        let mut parts: PartedRequest<'_, '_, usize, usize> =
            limits.parts(LimitedService::Write, &questions);
        let first = parts.next_part().unwrap().to_vec();
        parts.answered(Ok(first)).unwrap();
        parts.next_part().unwrap();
        let lost = Error::new(StatusCode::BadResponseTooLarge, "");
        assert!(matches!(
            parts.answered(Err(lost)),
            Err(PartFault::Failed(_))
        ));
        parts.skip(&77);
        parts.skip_all(&78);
        assert!(parts.next_part().is_none());
        let expected = [(0..10).collect(), vec![77; 10], vec![78; 5]].concat();
        assert_eq!(parts.into_answers(), expected);

        let mut parts: PartedRequest<'_, '_, usize, usize> =
            limits.parts(LimitedService::Read, &questions);
        parts.next_part().unwrap();
        assert!(matches!(parts.answered(Ok(vec![1])), Err(PartFault::Short)));
    }
}
