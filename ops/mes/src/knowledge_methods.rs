//! Queries and changes of the knowledge for clients of the OPC UA server: the object `Knowledge`
//! with the methods Query, Update, Load and ImportMtp.
//!
//! A fault of the input is an output of the method, with its line. A call fails only if the client
//! may not make it.

use std::future::Future;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use knowledge::{KnowledgeRefusal, KnowledgeRequests, QueryRequest, SourceFinding};
use plant_opcua::server::{
    EndpointUrl, IdRange, InstanceError, MethodHandler, MethodRefusal, MethodRequest, MethodSpec,
    ObjectSpec, OpcUaServer, SessionCaller,
};
use plant_opcua::types::{
    Argument, ByteString, DataTypeId, LocalizedText, NodeId, ObjectTypeId, QualifiedName,
    ReferenceTypeId, StatusCode, Variant,
};
use plant_opcua::users::{NodePermissions, Roles, UserAccess, UserRole};
use tracing::{info, warn};
use uri_text::is_loopback_host;

/// The object `Knowledge`.
#[derive(Debug, Clone)]
pub(crate) struct KnowledgeMethods {
    requests: KnowledgeRequests,
    /// The users of the interface over HTTP.
    access: Arc<UserAccess>,
    is_loopback: bool,
}

impl KnowledgeMethods {
    /// Creates the object for the server at an endpoint. Changes need the rights of `access`.
    pub(crate) fn new(
        requests: KnowledgeRequests,
        access: Arc<UserAccess>,
        endpoint: &str,
    ) -> Self {
        let url = endpoint.parse::<EndpointUrl>();
        Self {
            requests,
            access,
            is_loopback: url.is_ok_and(|url| is_loopback_host(url.host())),
        }
    }

    /// Checks that a caller may change the knowledge, as over HTTP: engineers, and programs of this
    /// host while there is no user.
    fn may_change(&self, caller: &SessionCaller) -> Result<(), StatusCode> {
        self.access.look();
        let roles = self.access.roles_of(caller);
        let is_own = self.is_loopback && !self.access.has_users();
        if roles.contains(UserRole::Engineer) || (is_own && roles.contains(UserRole::Operator)) {
            return Ok(());
        }
        warn!(
            user = caller.user,
            application = caller.application_uri,
            hint = "ua-server user role NAME engineer",
            "refused a change of the knowledge"
        );
        Err(StatusCode::BadUserAccessDenied)
    }

    async fn query(
        &self,
        caller: &SessionCaller,
        arguments: &[Variant],
    ) -> Result<Vec<Variant>, StatusCode> {
        let [
            Variant::String(text),
            Variant::String(format),
            Variant::UInt32(rows),
        ] = arguments
        else {
            return Err(StatusCode::BadInvalidArgument);
        };
        let found = self.requests.query(QueryRequest {
            text: text.as_ref(),
            format: format.as_ref(),
            rows: usize::try_from(*rows).unwrap_or(usize::MAX),
            user: &caller.user,
        });
        let (written, refusal) = match found.await {
            Ok(written) => (Some(written), None),
            Err(refusal) => (None, Some(refusal)),
        };
        let (media, bytes, rows, is_truncated) = written.map_or_else(Default::default, |written| {
            let rows = u32::try_from(written.rows).unwrap_or(u32::MAX);
            (written.media, written.bytes, rows, written.is_truncated)
        });
        // All formats of results are UTF-8.
        let result = String::from_utf8_lossy(&bytes);
        let mut outputs = vec![
            Variant::from(result.as_ref()),
            Variant::from(media),
            rows.into(),
            is_truncated.into(),
        ];
        outputs.extend(fault(refusal.as_ref()));
        Ok(outputs)
    }

    async fn update(
        &self,
        caller: &SessionCaller,
        arguments: &[Variant],
    ) -> Result<Vec<Variant>, StatusCode> {
        self.may_change(caller)?;
        let [Variant::String(text)] = arguments else {
            return Err(StatusCode::BadInvalidArgument);
        };
        let (user, length) = (&caller.user, text.as_ref().len());
        // The change may outlive this call, which ends with the session of the client.
        info!(
            user,
            kind = "update",
            length,
            "update of the knowledge begins"
        );
        let (changed, refusal) = match self.requests.update(text.as_ref().to_owned()).await {
            Ok(changed) => (changed, None),
            Err(refusal) => (0, Some(refusal)),
        };
        info!(user, changed, refused = ?refusal, "update of the knowledge");
        let mut outputs = vec![u64::try_from(changed).unwrap_or(u64::MAX).into()];
        outputs.extend(fault(refusal.as_ref()));
        Ok(outputs)
    }

    async fn load(
        &self,
        caller: &SessionCaller,
        (kind, name): (&str, &str),
        contents: &ByteString,
    ) -> Result<Vec<Variant>, StatusCode> {
        self.may_change(caller)?;
        let contents = contents.value.clone().unwrap_or_default();
        let (user, length) = (&caller.user, contents.len());
        // The change may outlive this call, which ends with the session of the client.
        info!(user, kind, name, length, "load of a source begins");
        let (is_new, findings, refusal) = match self.requests.load((kind, name), contents).await {
            Ok(loaded) => (loaded.is_new, loaded.findings, None),
            Err(mut refusal) => (false, std::mem::take(&mut refusal.findings), Some(refusal)),
        };
        info!(user, kind, name, refused = ?refusal, "load of a source");
        let texts: Vec<String> = findings.iter().map(|found| found.what.clone()).collect();
        let lines: Vec<u32> = findings.iter().map(line_of_finding).collect();
        let mut outputs = vec![is_new.into(), Variant::from(texts), Variant::from(lines)];
        outputs.extend(fault(refusal.as_ref()));
        Ok(outputs)
    }
}

/// A method of the object.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum KnowledgeMethod {
    Query,
    Update,
    Load,
    ImportMtp,
}

impl KnowledgeMethod {
    const ALL: [Self; 4] = [Self::Query, Self::Update, Self::Load, Self::ImportMtp];

    const fn name(self) -> &'static str {
        match self {
            Self::Query => "Query",
            Self::Update => "Update",
            Self::Load => "Load",
            Self::ImportMtp => "ImportMtp",
        }
    }

    /// Returns the roles that may call it. The change itself needs the role Engineer, or no user.
    fn callers(self) -> Roles {
        match self {
            Self::Query => Roles::ALL,
            Self::Update | Self::Load | Self::ImportMtp => NodePermissions::default().call,
        }
    }

    fn takes(self) -> Vec<Argument> {
        let name = argument("Name", DataTypeId::String, "The name of the source");
        match self {
            Self::Query => vec![
                argument("Query", DataTypeId::String, "A query of SPARQL 1.1"),
                argument(
                    "Format",
                    DataTypeId::String,
                    "The media type of the result; JSON, or N-Triples for statements, if empty",
                ),
                argument(
                    "MaxRows",
                    DataTypeId::UInt32,
                    "The largest number of rows; the limit of the server if 0",
                ),
            ],
            Self::Update => vec![argument(
                "Update",
                DataTypeId::String,
                "An update of SPARQL 1.1, whose operations are one change",
            )],
            Self::Load => vec![
                argument(
                    "Kind",
                    DataTypeId::String,
                    "nodeset, mtp, file (Turtle), process (Turtle, BatchML, BPMN) or product (STEP)",
                ),
                name,
                argument(
                    "Contents",
                    DataTypeId::ByteString,
                    "The contents of the file",
                ),
            ],
            Self::ImportMtp => vec![
                name,
                argument(
                    "Manifest",
                    DataTypeId::ByteString,
                    "An .aml, .mtp or .amlx file",
                ),
            ],
        }
    }

    fn gives(self) -> Vec<Argument> {
        let list = |of: Argument| Argument {
            value_rank: 1,
            ..of
        };
        let mut gives = match self {
            Self::Query => vec![
                argument("Result", DataTypeId::String, "The result in its format"),
                argument("MediaType", DataTypeId::String, "The format of the result"),
                argument("Rows", DataTypeId::UInt32, "The number of rows"),
                argument(
                    "Truncated",
                    DataTypeId::Boolean,
                    "Whether there are more rows",
                ),
            ],
            Self::Update => vec![argument(
                "Changed",
                DataTypeId::UInt64,
                "The number of changed statements",
            )],
            Self::Load | Self::ImportMtp => vec![
                argument("IsNew", DataTypeId::Boolean, "False if it was replaced"),
                list(argument("Findings", DataTypeId::String, "All findings")),
                list(argument(
                    "Lines",
                    DataTypeId::UInt32,
                    "Their lines, from 1; 0 if unknown",
                )),
            ],
        };
        gives.extend([
            argument(
                "Error",
                DataTypeId::String,
                "The code of the fault; empty if done",
            ),
            argument("Message", DataTypeId::String, "The fault"),
            argument(
                "Line",
                DataTypeId::UInt32,
                "The line of the fault; 0 if unknown",
            ),
        ]);
        gives
    }
}

fn argument(name: &str, data_type: DataTypeId, about: &str) -> Argument {
    Argument {
        name: name.into(),
        data_type: data_type.into(),
        value_rank: -1,
        array_dimensions: None,
        description: LocalizedText::new("en", about),
    }
}

/// Returns the outputs Error, Message and Line.
fn fault(refusal: Option<&KnowledgeRefusal>) -> [Variant; 3] {
    let (code, message, line) = match refusal {
        Some(refusal) => (refusal.code, refusal.message.as_str(), refusal.line),
        None => ("", "", None),
    };
    [code.into(), message.into(), number(line).into()]
}

fn line_of_finding(found: &SourceFinding) -> u32 {
    number(found.line)
}

fn number(line: Option<usize>) -> u32 {
    line.map_or(0, |line| u32::try_from(line).unwrap_or(u32::MAX))
}

/// Executes the calls of a method.
struct KnowledgeCall {
    knowledge: KnowledgeMethods,
    method: KnowledgeMethod,
}

#[async_trait]
impl MethodHandler for KnowledgeCall {
    fn longest(&self) -> Duration {
        match self.method {
            KnowledgeMethod::Query => LONGEST_QUERY,
            // An update is committed behind its query, whose limit does not hold for the commit.
            KnowledgeMethod::Update | KnowledgeMethod::Load | KnowledgeMethod::ImportMtp => {
                LONGEST_CHANGE
            }
        }
    }

    async fn call(&self, request: MethodRequest) -> Result<Vec<Variant>, MethodRefusal> {
        let (caller, arguments) = (&request.caller, request.arguments.as_slice());
        let knowledge = &self.knowledge;
        let done = async {
            match (self.method, arguments) {
                (KnowledgeMethod::Query, _) => knowledge.query(caller, arguments).await,
                (KnowledgeMethod::Update, _) => knowledge.update(caller, arguments).await,
                (
                    KnowledgeMethod::Load,
                    [
                        Variant::String(kind),
                        Variant::String(name),
                        Variant::ByteString(contents),
                    ],
                ) => {
                    let named = (kind.as_ref(), name.as_ref());
                    knowledge.load(caller, named, contents).await
                }
                (
                    KnowledgeMethod::ImportMtp,
                    [Variant::String(name), Variant::ByteString(contents)],
                ) => {
                    let named = ("mtp", name.as_ref());
                    knowledge.load(caller, named, contents).await
                }
                (KnowledgeMethod::Load | KnowledgeMethod::ImportMtp, _) => {
                    Err(StatusCode::BadInvalidArgument)
                }
            }
        };
        let done = while_lasts(|| request.presence.lasts(), done).await;
        let done = done.unwrap_or(Err(StatusCode::BadSessionClosed));
        done.map_err(MethodRefusal::from)
    }
}

/// Waits for the end of a request. `None`, and the request is cancelled, if the session of the
/// client ends before.
async fn while_lasts<T>(lasts: impl Fn() -> bool, work: impl Future<Output = T>) -> Option<T> {
    tokio::pin!(work);
    let mut looks = tokio::time::interval(LOOK);
    loop {
        tokio::select! {
            done = &mut work => return Some(done),
            _ = looks.tick() => if !lasts() {
                return None;
            }
        }
    }
}

impl skills::server::Extension for KnowledgeMethods {
    fn serve(
        &self,
        (server, users): (&OpcUaServer, &UserAccess),
        component: &NodeId,
        ids: &mut IdRange,
    ) -> Result<(), InstanceError> {
        let own = component.namespace;
        let object = ObjectSpec {
            node_id: ids.next(),
            browse_name: QualifiedName::new(own, OBJECT),
            display_name: OBJECT.into(),
            type_definition: ObjectTypeId::BaseObjectType.into(),
            parent: component.clone(),
            reference: ReferenceTypeId::HasComponent.into(),
            event_notifier: false,
        };
        server.add_object(&object)?;
        for method in KnowledgeMethod::ALL {
            let node_id = ids.next();
            let permissions = NodePermissions {
                call: method.callers(),
                ..NodePermissions::default()
            };
            users.permit(node_id.clone(), permissions);
            let spec = MethodSpec {
                node_id,
                browse_name: QualifiedName::new(own, method.name()),
                object: object.node_id.clone(),
                arguments: (ids.next(), ids.next()),
                takes: method.takes(),
                gives: method.gives(),
            };
            let knowledge = self.clone();
            server.add_method(spec, Arc::new(KnowledgeCall { knowledge, method }))?;
        }
        Ok(())
    }
}

const OBJECT: &str = "Knowledge";
/// Exceeds the time limit of a query, with its wait for a place.
const LONGEST_QUERY: Duration = Duration::from_secs(15);
const LONGEST_CHANGE: Duration = Duration::from_secs(60);
/// Period of the checks of the session.
const LOOK: Duration = Duration::from_millis(100);

#[cfg(test)]
mod tests {
    use std::sync::Mutex;
    use std::sync::atomic::{AtomicUsize, Ordering};

    use knowledge::{JobRunner, Knowledge, Queries, QueryLimits, Writes};
    use plant_opcua::users::{FOLDER, StoredUser, Users, hashed};
    use tracing::field::Field;
    use tracing::{Event, Metadata, Subscriber, span};

    use super::*;
    use crate::sources::MesSources;

    struct NoJobs;

    impl JobRunner for NoJobs {
        fn start(&self, _: &str) -> Result<Option<u64>, String> {
            Ok(None)
        }

        fn stop(&self, _: u64) -> bool {
            false
        }

        fn list(&self) -> serde_json::Value {
            serde_json::Value::Null
        }
    }

    fn methods(access: UserAccess, endpoint: &str) -> KnowledgeMethods {
        let knowledge = Arc::new(Knowledge::new().unwrap());
        let writes = Writes {
            now: || 1,
            may_read: Arc::new(|_| Box::pin(async { false })),
            may: Arc::new(|_| Box::pin(async { false })),
            may_run: Arc::new(|_| Box::pin(async { false })),
            files: Arc::new(MesSources::new(Arc::clone(&knowledge))),
            jobs: Arc::new(NoJobs),
        };
        let queries = Queries::new(knowledge, QueryLimits::default());
        let requests = KnowledgeRequests::new(queries, &writes);
        KnowledgeMethods::new(requests, Arc::new(access), endpoint)
    }

    fn caller(user: &str) -> SessionCaller {
        SessionCaller {
            session: 1,
            user: user.to_owned(),
            application_uri: "urn:client".to_owned(),
            proven: false,
            encrypted: false,
            certificate: None,
        }
    }

    const LOOPBACK: &str = "opc.tcp://127.0.0.1:0";

    #[tokio::test]
    async fn engineers_change_the_knowledge_and_all_others_read_it() {
        let folder = std::env::temp_dir().join(format!("knowledge-methods-{}", std::process::id()));
        let users = folder.join(FOLDER);
        drop(std::fs::remove_dir_all(&folder));
        let anonymous = caller("anonymous");
        let access = || UserAccess::new(Some(users.clone()), true).unwrap();
        let own = methods(access(), LOOPBACK);
        assert_eq!(
            own.may_change(&anonymous),
            Ok(()),
            "without users, on this host"
        );
        let denied = Err(StatusCode::BadUserAccessDenied);
        let elsewhere = methods(access(), "opc.tcp://0.0.0.0:4840");
        assert_eq!(elsewhere.may_change(&anonymous), denied);

        let mut known = Users::default();
        for (name, role) in [("anna", UserRole::Engineer), ("otto", UserRole::Operator)] {
            let user = StoredUser {
                roles: Roles::of(&[role]),
                credential: hashed(b"a long password").unwrap(),
            };
            known.put(name, user).unwrap();
        }
        known.write(&users).unwrap();
        let own = methods(access(), LOOPBACK);
        assert_eq!(own.may_change(&anonymous), denied, "there are users");
        assert_eq!(own.may_change(&caller("otto")), denied);
        assert_eq!(own.may_change(&caller("anna")), Ok(()));
        let update = [Variant::from("INSERT DATA { <urn:a> <urn:p> 1 }")];
        assert_eq!(
            own.update(&caller("otto"), &update).await,
            Err(StatusCode::BadUserAccessDenied)
        );
        let done = own.update(&caller("anna"), &update).await.unwrap();
        assert_eq!(done[..2], [Variant::from(1_u64), Variant::from("")]);
        let query = ["SELECT ?o { <urn:a> ?p ?o }", "text/csv"].map(Variant::from);
        let arguments = [&query[..], &[0_u32.into()]].concat();
        let found = own.query(&caller("otto"), &arguments).await.unwrap();
        assert_eq!(found[0], Variant::from("o\r\n1\r\n"));
        assert_eq!(found[2..4], [Variant::from(1_u32), Variant::from(false)]);
        drop(std::fs::remove_dir_all(&folder));
    }

    #[tokio::test]
    async fn a_fault_of_the_input_is_an_output_with_its_line() {
        let own = methods(UserAccess::new(None, true).unwrap(), LOOPBACK);
        let anonymous = caller("anonymous");
        let query = ["SELECT *\n{ ?s ?p }", ""].map(Variant::from);
        let arguments = [&query[..], &[0_u32.into()]].concat();
        let found = own.query(&anonymous, &arguments).await.unwrap();
        assert_eq!((&found[4], &found[6]), (&"malformed".into(), &2_u32.into()));
        let turtle = ByteString::from(b"<urn:a> <urn:p> 1 .\n<urn:a> 2".to_vec());
        let named = ("file", "a.ttl");
        let loaded = own.load(&anonymous, named, &turtle).await.unwrap();
        assert_eq!(
            (&loaded[3], &loaded[5]),
            (&"source".into(), &2_u32.into()),
            "{loaded:?}"
        );
        assert_eq!(loaded[2], Variant::from(vec![2_u32]));
        let manifest = concat!(
            env!("CARGO_MANIFEST_DIR"),
            "/../../tests/data/mtp/stage.aml"
        );
        let manifest = ByteString::from(std::fs::read(manifest).unwrap());
        for is_new in [true, false] {
            let loaded = own.load(&anonymous, ("mtp", "stage"), &manifest).await;
            let loaded = loaded.unwrap();
            assert_eq!((&loaded[0], &loaded[3]), (&is_new.into(), &"".into()));
        }
    }

    /// Collects the fields of log entries as texts.
    #[derive(Clone, Default)]
    struct Lines(Arc<Mutex<Vec<String>>>);

    impl Subscriber for Lines {
        fn enabled(&self, _: &Metadata<'_>) -> bool {
            true
        }

        fn new_span(&self, _: &span::Attributes<'_>) -> span::Id {
            span::Id::from_u64(1)
        }

        fn record(&self, _: &span::Id, _: &span::Record<'_>) {}

        fn record_follows_from(&self, _: &span::Id, _: &span::Id) {}

        fn event(&self, event: &Event<'_>) {
            let mut line = String::new();
            event.record(&mut |field: &Field, value: &dyn std::fmt::Debug| {
                line.push_str(&format!("{field}={value:?} "));
            });
            self.0.lock().unwrap().push(line);
        }

        fn enter(&self, _: &span::Id) {}

        fn exit(&self, _: &span::Id) {}
    }

    #[tokio::test]
    async fn a_change_whose_session_ends_has_a_log_entry() {
        let own = methods(UserAccess::new(None, true).unwrap(), LOOPBACK);
        let anonymous = caller("anonymous");
        let lines = Lines::default();
        let guard = tracing::subscriber::set_default(lines.clone());
        let update = [Variant::from("INSERT DATA { <urn:a> <urn:p> 1 }")];
        let turtle = ByteString::from(b"<urn:a> <urn:p> 1 .".to_vec());
        // Each call is dropped after it has begun.
        tokio::select! {
            biased;
            done = own.update(&anonymous, &update) => drop(done),
            () = std::future::ready(()) => {}
        }
        tokio::select! {
            biased;
            done = own.load(&anonymous, ("file", "a.ttl"), &turtle) => drop(done),
            () = std::future::ready(()) => {}
        }
        drop(guard);
        let lines = lines.0.lock().unwrap();
        for texts in [
            &["update of the knowledge begins", "user=\"anonymous\""][..],
            &["load of a source begins", "kind=\"file\"", "name=\"a.ttl\""],
        ] {
            let found = |line: &&String| texts.iter().all(|text| line.contains(text));
            assert!(lines.iter().find(found).is_some(), "{texts:?}: {lines:?}");
        }
    }

    #[test]
    fn an_update_has_the_time_limit_of_a_load() {
        let knowledge = methods(UserAccess::new(None, true).unwrap(), LOOPBACK);
        let longest = |method| {
            let knowledge = knowledge.clone();
            KnowledgeCall { knowledge, method }.longest()
        };
        let load = longest(KnowledgeMethod::Load);
        assert_eq!(longest(KnowledgeMethod::Update), load);
        assert!(longest(KnowledgeMethod::Query) < load);
    }

    #[tokio::test]
    async fn a_request_is_cancelled_when_its_session_ends() {
        let looks = AtomicUsize::new(0);
        let lasts = || looks.fetch_add(1, Ordering::Relaxed) < 2;
        let ready = std::future::ready(7);
        assert_eq!(while_lasts(lasts, ready).await, Some(7));
        let never = std::future::pending::<u32>();
        assert_eq!(while_lasts(lasts, never).await, None);
    }
}
