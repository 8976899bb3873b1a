//! The services that a client calls: Read, Write, Browse, TranslateBrowsePathsToNodeIds and Call.

use std::time::Duration;

use opcua::client::UARequest as _;
use opcua::client::services::Call;
use opcua::types::{
    AttributeId, BrowseDescription, BrowseDirection, BrowsePath, BrowseResult, BrowseResultMask,
    ByteString, CallMethodRequest, DataValue, NodeClassMask, NodeId, QualifiedName, ReadValueId,
    ReferenceDescription, ReferenceTypeId, RelativePath, RelativePathElement, StatusCode,
    TimestampsToReturn, Variant, WriteValue,
};

use super::supervisor::{ConnectedClient, failed};
use super::{ClientError, LimitedService, OpcUaClient};

/// The references to follow.
#[derive(Debug, Clone)]
pub struct Browse {
    /// The reference type.
    pub reference: NodeId,
    /// Whether subtypes of the reference type are included.
    pub subtypes: bool,
    /// Whether inverse references are followed.
    pub inverse: bool,
    /// The NodeClasses of the targets; empty for all.
    pub classes: NodeClassMask,
}

impl Browse {
    /// Follows hierarchical references forward.
    #[must_use]
    pub fn hierarchical() -> Self {
        Self::of(ReferenceTypeId::HierarchicalReferences)
    }

    /// Follows references of this type and its subtypes forward.
    pub fn of(reference: impl Into<NodeId>) -> Self {
        Self {
            reference: reference.into(),
            subtypes: true,
            inverse: false,
            classes: NodeClassMask::empty(),
        }
    }

    /// Follows inverse references instead.
    #[must_use]
    pub fn inverse(mut self) -> Self {
        self.inverse = true;
        self
    }

    fn of_node(&self, node: &NodeId) -> BrowseDescription {
        BrowseDescription {
            node_id: node.clone(),
            browse_direction: match self.inverse {
                true => BrowseDirection::Inverse,
                false => BrowseDirection::Forward,
            },
            reference_type_id: self.reference.clone(),
            include_subtypes: self.subtypes,
            node_class_mask: self.classes.bits(),
            result_mask: BrowseResultMask::All as u32,
        }
    }
}

/// The references of a node, as far as they were read.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct BrowsedReferences {
    /// The references.
    pub references: Vec<ReferenceDescription>,
    /// Whether the server has no more references of the node.
    pub is_whole: bool,
    /// The status of the node, which is Bad for a node that does not exist.
    pub status: StatusCode,
}

/// The options of a method call.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CallOptions {
    /// The timeout of the call.
    pub within: Duration,
    /// Restricts the call to this connection (`connects` of [`Link::Up`](super::Link::Up)): after a
    /// reconnect a NodeId may identify another node.
    pub connection: Option<u64>,
}

/// The result of one method call as the server sent it.
#[derive(Debug, Clone, PartialEq)]
pub struct CallResult {
    /// The status of the call, which may be Bad or Uncertain.
    pub status: StatusCode,
    /// The status of each input argument; empty where the server sends none.
    pub arguments: Vec<StatusCode>,
    /// The output arguments.
    pub outputs: Vec<Variant>,
}

/// An error of a method call.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum CallError {
    /// The server refused the call.
    #[error("the call is refused with {status}")]
    Refused {
        /// The status code.
        status: StatusCode,
        /// The status of each input argument, if the server sends it.
        arguments: Vec<StatusCode>,
    },
    /// The call has no response. After [`ClientError::Lost`] it is unknown whether the method was
    /// executed.
    #[error(transparent)]
    Client(#[from] ClientError),
}

impl OpcUaClient {
    /// Reads the values of nodes. The result has one value per node, including bad values.
    ///
    /// # Errors
    /// Returns an error if a request has no response.
    pub async fn read(&self, nodes: &[NodeId]) -> Result<Vec<DataValue>, ClientError> {
        let what: Vec<_> = nodes
            .iter()
            .map(|node| (node.clone(), AttributeId::Value))
            .collect();
        self.read_attributes(&what).await
    }

    /// Reads attributes. The result has one value per attribute, including bad values.
    ///
    /// # Errors
    /// Returns an error if a request has no response.
    pub async fn read_attributes(
        &self,
        what: &[(NodeId, AttributeId)],
    ) -> Result<Vec<DataValue>, ClientError> {
        let nodes: Vec<_> = what
            .iter()
            .map(|(node, attribute)| ReadValueId {
                node_id: node.clone(),
                attribute_id: *attribute as u32,
                ..ReadValueId::default()
            })
            .collect();
        let connected = self.shared.connected()?;
        let mut parts = connected.limits.parts(LimitedService::Read, &nodes);
        while let Some(nodes) = parts.next_part() {
            let read = connected.session.read(nodes, TimestampsToReturn::Both, 0.0);
            parts.answered(read.await)?;
        }
        Ok(parts.into_answers())
    }

    /// Writes values, and returns a status code for each value.
    ///
    /// # Errors
    /// Returns the first error. Other values may have been written;
    /// [`write_each`](Self::write_each) returns the result of each value.
    pub async fn write(
        &self,
        values: &[(NodeId, Variant)],
    ) -> Result<Vec<StatusCode>, ClientError> {
        self.write_each(values).await.into_iter().collect()
    }

    /// Writes values, and returns the result of each value, also if the server accepts fewer values
    /// in a request.
    pub async fn write_each(
        &self,
        values: &[(NodeId, Variant)],
    ) -> Vec<Result<StatusCode, ClientError>> {
        let writes: Vec<_> = values
            .iter()
            .map(|(node, value)| WriteValue {
                node_id: node.clone(),
                attribute_id: AttributeId::Value as u32,
                value: DataValue {
                    value: Some(value.clone()),
                    ..DataValue::default()
                },
                ..WriteValue::default()
            })
            .collect();
        let connected = match self.shared.connected() {
            Ok(connected) => connected,
            Err(error) => return values.iter().map(|_| Err(error.clone())).collect(),
        };
        let mut parts = connected.limits.parts(LimitedService::Write, &writes);
        while let Some(writes) = parts.next_part() {
            let written = connected.session.write(writes).await;
            let written = written.map(|statuses| statuses.into_iter().map(Ok).collect());
            let Err(fault) = parts.answered(written) else {
                continue;
            };
            let fault = ClientError::from(fault);
            parts.skip(&Err(fault.clone()));
            if matches!(fault, ClientError::Lost(_)) {
                let unsent = format!("not sent after {fault}");
                parts.skip_all(&Err(ClientError::NotConnected(unsent)));
            }
        }
        parts.into_answers()
    }

    /// Returns the references of a node, at most [`MOST_REFERENCES`].
    ///
    /// # Errors
    /// Returns an error if the request has no response or the node does not exist.
    pub async fn browse(
        &self,
        node: &NodeId,
        what: Browse,
    ) -> Result<Vec<ReferenceDescription>, ClientError> {
        let connected = self.shared.connected()?;
        let description = what.of_node(node);
        let browsed = connected.session.browse(&[description], 0, None).await;
        let first = as_many(browsed, 1)?.pop().unwrap_or_default();
        let found = pages(&connected, first, MOST_REFERENCES).await?;
        match found.status.is_bad() {
            true => Err(ClientError::Status(found.status)),
            false => Ok(found.references),
        }
    }

    /// Returns the references of several nodes, at most `most` altogether and `page` of a node in a
    /// response. A lying server is bounded: it cannot make a result endless.
    ///
    /// # Errors
    /// Returns an error if a request has no response.
    pub async fn browse_within(
        &self,
        nodes: &[NodeId],
        what: &Browse,
        (most, page): (usize, u32),
    ) -> Result<Vec<BrowsedReferences>, ClientError> {
        let connected = self.shared.connected()?;
        let descriptions: Vec<_> = nodes.iter().map(|node| what.of_node(node)).collect();
        let mut all: Vec<BrowsedReferences> = Vec::with_capacity(nodes.len());
        let mut left = most;
        // The continuation points of a part are used before another part needs some.
        while let Some(rest) = descriptions
            .get(all.len()..)
            .filter(|rest| !rest.is_empty())
        {
            let size = connected.limits.most(LimitedService::Browse);
            let part = rest.get(..size.min(rest.len())).unwrap_or(rest);
            let mut parts = connected.limits.parts(LimitedService::Browse, part);
            while let Some(part) = parts.next_part() {
                parts.answered(connected.session.browse(part, page, None).await)?;
            }
            for (description, first) in part.iter().zip(parts.into_answers()) {
                let first = match first.status_code {
                    StatusCode::BadNoContinuationPoints => {
                        let again = std::slice::from_ref(description);
                        let browsed = connected.session.browse(again, page, None).await;
                        as_many(browsed, 1)?.pop().unwrap_or_default()
                    }
                    _ => first,
                };
                let found = pages(&connected, first, left).await?;
                left = left.saturating_sub(found.references.len());
                all.push(found);
            }
        }
        Ok(all)
    }

    /// Returns the references of several nodes, at most [`MOST_REFERENCES`] of each. A node that
    /// does not exist has no references.
    ///
    /// # Errors
    /// Returns an error if a request has no response.
    pub async fn browse_all(
        &self,
        nodes: &[NodeId],
        what: &Browse,
    ) -> Result<Vec<Vec<ReferenceDescription>>, ClientError> {
        let connected = self.shared.connected()?;
        let descriptions: Vec<_> = nodes.iter().map(|node| what.of_node(node)).collect();
        let mut parts = connected
            .limits
            .parts(LimitedService::Browse, &descriptions);
        while let Some(part) = parts.next_part() {
            parts.answered(connected.session.browse(part, 0, None).await)?;
        }
        let mut all = Vec::with_capacity(nodes.len());
        for (node, first) in nodes.iter().zip(parts.into_answers()) {
            let found = match first.status_code {
                // A server has a limited number of continuation points.
                StatusCode::BadNoContinuationPoints => self.browse(node, what.clone()).await,
                _ => pages(&connected, first, MOST_REFERENCES)
                    .await
                    .map(|found| found.references),
            };
            all.push(match found {
                Err(ClientError::Status(_)) => Vec::new(),
                found => found?,
            });
        }
        Ok(all)
    }

    /// Returns the node at a path of BrowseNames along hierarchical references.
    ///
    /// # Errors
    /// Returns an error if the request has no response, or `BadNoMatch`.
    pub async fn translate(
        &self,
        node: &NodeId,
        path: &[QualifiedName],
    ) -> Result<NodeId, ClientError> {
        let elements = path.iter().map(|name| RelativePathElement {
            reference_type_id: ReferenceTypeId::HierarchicalReferences.into(),
            is_inverse: false,
            include_subtypes: true,
            target_name: name.clone(),
        });
        let path = BrowsePath {
            starting_node: node.clone(),
            relative_path: RelativePath {
                elements: Some(elements.collect()),
            },
        };
        let session = self.shared.connected()?;
        let translated = session
            .session
            .translate_browse_paths_to_node_ids(&[path])
            .await;
        let result = as_many(translated, 1)?
            .pop()
            .ok_or(ClientError::Answer("no path"))?;
        if result.status_code.is_bad() {
            return Err(ClientError::Status(result.status_code));
        }
        let whole = result.targets.into_iter().flatten();
        let target = whole
            .into_iter()
            .find(|target| target.remaining_path_index == u32::MAX);
        target
            .map(|target| target.target_id.node_id)
            .ok_or(ClientError::Status(StatusCode::BadNoMatch))
    }

    /// Calls a method of an object.
    ///
    /// # Errors
    /// Returns an error if the server refuses the call or the call has no response.
    pub async fn call(
        &self,
        object: &NodeId,
        method: &NodeId,
        arguments: Vec<Variant>,
    ) -> Result<Vec<Variant>, CallError> {
        let options = CallOptions {
            within: self.shared.config.timeout,
            connection: None,
        };
        self.call_within((object, method), arguments, options).await
    }

    /// Calls a method of an object with its own timeout, which the server receives as TimeoutHint
    /// (OPC 10000-4, 7.33).
    ///
    /// # Errors
    /// Returns an error if the server refuses the call or the call has no response.
    pub async fn call_within(
        &self,
        target: (&NodeId, &NodeId),
        arguments: Vec<Variant>,
        options: CallOptions,
    ) -> Result<Vec<Variant>, CallError> {
        let result = self.call_result(target, arguments, options).await?;
        if result.status.is_bad() {
            return Err(CallError::Refused {
                status: result.status,
                arguments: result.arguments,
            });
        }
        Ok(result.outputs)
    }

    /// Calls a method of an object, and returns the result with its status code, Good or not.
    ///
    /// # Errors
    /// Returns an error if the call has no result.
    pub async fn call_result(
        &self,
        (object, method): (&NodeId, &NodeId),
        arguments: Vec<Variant>,
        options: CallOptions,
    ) -> Result<CallResult, ClientError> {
        let request = CallMethodRequest {
            object_id: object.clone(),
            method_id: method.clone(),
            input_arguments: (!arguments.is_empty()).then_some(arguments),
        };
        let session = self.shared.connected()?;
        if options
            .connection
            .is_some_and(|one| one != session.connects)
        {
            let other = "the connection was replaced".to_owned();
            return Err(ClientError::NotConnected(other));
        }
        let _in_flight = self.shared.calls.start();
        let call = Call::new(&session.session)
            .methods_to_call(vec![request])
            .timeout(options.within);
        let called = call.send(session.session.channel()).await;
        let called = called.map(|response| response.results.unwrap_or_default());
        let result = as_many(called, 1)?
            .pop()
            .ok_or(ClientError::Answer("no result"))?;
        Ok(CallResult {
            status: result.status_code,
            arguments: result.input_argument_results.unwrap_or_default(),
            outputs: result.output_arguments.unwrap_or_default(),
        })
    }
}

/// Returns the references of the first page and of the pages that follow, at most `most`.
/// References that precede a Bad page are dropped.
async fn pages(
    connected: &ConnectedClient,
    first: BrowseResult,
    most: usize,
) -> Result<BrowsedReferences, ClientError> {
    let session = &connected.session;
    let mut found = BrowsedReferences {
        is_whole: true,
        ..BrowsedReferences::default()
    };
    let mut empty_pages = 0;
    let mut page = Some(first);
    while let Some(result) = page.take() {
        if result.status_code.is_bad() {
            return Ok(BrowsedReferences {
                status: result.status_code,
                ..BrowsedReferences::default()
            });
        }
        let before = found.references.len();
        found
            .references
            .extend(result.references.into_iter().flatten());
        let more: ByteString = result.continuation_point;
        if more.is_null_or_empty() {
            break;
        }
        // A faulty server may continue without end.
        if found.references.len() == before {
            empty_pages += 1;
        }
        let enough = found.references.len() >= most || empty_pages > MOST_EMPTY_PAGES;
        let next = session.browse_next(enough, &[more]).await;
        if enough {
            found.is_whole = false;
            break;
        }
        page = as_many(next, 1)?.pop();
    }
    if found.references.len() > most {
        found.references.truncate(most);
        found.is_whole = false;
    }
    Ok(found)
}

/// Returns the results of a response if their number is as expected.
fn as_many<T>(
    answer: Result<Vec<T>, opcua::types::Error>,
    wanted: usize,
) -> Result<Vec<T>, ClientError> {
    let answer = answer.map_err(|error| failed(&error))?;
    if answer.len() != wanted {
        return Err(ClientError::Answer("a wrong number of results"));
    }
    Ok(answer)
}

/// Maximum number of pages without a reference in the references of a node.
const MOST_EMPTY_PAGES: usize = 8;
/// Maximum number of references of a node that are returned.
pub const MOST_REFERENCES: usize = 10_000;
