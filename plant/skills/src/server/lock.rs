//! Locking of a component (OPC 10000-100, 7): a session holds the lease of its skills without
//! running them.

use std::future::Future;
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use plant_opcua::server::{
    IdRange, Instance, InstanceError, InstanceSpec, MethodRequest, OpcUaServer, method,
};
use plant_opcua::types::{NodeId, QualifiedName, StatusCode, Variant};
use tokio::sync::watch;
use tokio::time::{Instant, sleep_until};

use crate::authority::{Authority, SkillOwner};
use crate::lock::lock;
pub(super) use crate::model::DEVICES as NAMESPACE;

/// The part of the DI NodeSet that defines locking, for components that need no other part of it.
pub(super) const NODESET: &str = include_str!("locking.xml");

/// Returns whether a NodeSet file defines the complete namespace. The loader reports files that
/// cannot be read.
pub(super) fn has_di(file: &Path) -> bool {
    let text = std::fs::read_to_string(file).unwrap_or_default();
    let model = format!("<Model ModelUri=\"{NAMESPACE}\"");
    text.contains(&model)
}

/// The object Lock of a component.
#[derive(Clone)]
pub(super) struct Lock {
    server: OpcUaServer,
    authority: Authority,
    object: Instance,
    held: Arc<Mutex<Option<Held>>>,
    changed: watch::Sender<()>,
}

/// A lock that a session holds.
#[derive(Debug, Clone)]
struct Held {
    session: u32,
    until: Instant,
}

impl Lock {
    /// Creates the object below the component. The returned future ends locks that are not renewed
    /// and locks of sessions that lost the lease.
    pub(super) fn serve(
        server: &OpcUaServer,
        authority: &Authority,
        component: &NodeId,
        ids: &mut IdRange,
    ) -> Result<impl Future<Output = ()> + use<>, InstanceError> {
        let none = || InstanceError::NoType(NodeId::null());
        let of_type = server
            .find_type(NAMESPACE, "LockingServicesType")
            .ok_or_else(none)?;
        let name = QualifiedName::new(server.namespace(NAMESPACE).unwrap_or_default(), "Lock");
        let spec = InstanceSpec::new(of_type, ids.next(), name, component.clone());
        let object = server.instantiate(&spec, &mut |_| ids.next())?;
        let lock = Self {
            server: server.clone(),
            authority: authority.clone(),
            object,
            held: Arc::default(),
            changed: watch::channel(()).0,
        };
        lock.show(None);
        for (name, call) in [
            (
                "InitLock",
                Self::init as fn(&Self, &MethodRequest) -> Answer,
            ),
            ("RenewLock", Self::renew),
            ("ExitLock", Self::exit),
            ("BreakLock", Self::break_lock),
        ] {
            let Some(node) = lock.object.node(name).cloned() else {
                continue;
            };
            let own = lock.clone();
            let handler = method(move |request| match call(&own, &request) {
                Ok(status) => Ok(vec![status.into()]),
                Err(status) => Err(status.into()),
            });
            server.on_call(&lock.object.node_id, &node, handler);
        }
        Ok(lock.watch())
    }

    fn init(&self, request: &MethodRequest) -> Answer {
        let session = request.caller.session;
        if self
            .authority
            .lock_for(&SkillOwner::Session(session))
            .is_err()
        {
            return Ok(ALREADY_LOCKED);
        }
        let context = match request.arguments.first() {
            Some(Variant::String(context)) => context.as_ref().to_owned(),
            _ => String::new(),
        };
        self.hold(session);
        // Without a context, the lock is shown with the ApplicationUri of the client.
        let client = if context.is_empty() {
            request.caller.application_uri.clone()
        } else {
            context
        };
        self.show(Some((&client, &request.caller.user)));
        Ok(DONE)
    }

    fn renew(&self, request: &MethodRequest) -> Answer {
        if !self.is_held_by(request) {
            return Ok(NOT_LOCKED);
        }
        self.hold(request.caller.session);
        Ok(DONE)
    }

    fn exit(&self, request: &MethodRequest) -> Answer {
        if !self.is_held_by(request) {
            return Ok(NOT_LOCKED);
        }
        self.free();
        Ok(DONE)
    }

    /// Always refused: the method is for administrators, and a component has no administrators.
    fn break_lock(&self, _request: &MethodRequest) -> Answer {
        Err(StatusCode::BadUserAccessDenied)
    }

    fn is_held_by(&self, request: &MethodRequest) -> bool {
        lock(&self.held)
            .as_ref()
            .is_some_and(|held| held.session == request.caller.session)
    }

    fn hold(&self, session: u32) {
        let until = Instant::now() + LONGEST_LOCK;
        *lock(&self.held) = Some(Held { session, until });
        self.changed.send_replace(());
    }

    fn free(&self) {
        let held = lock(&self.held).take();
        if let Some(held) = held {
            self.authority.release(&SkillOwner::Session(held.session));
        }
        self.show(None);
        self.changed.send_replace(());
    }

    /// Ends an expired lock. Activity of the holder extends the lock without a renewal.
    fn end_or_extend(&self, held: &Held) {
        let now = Instant::now();
        let idle = self.authority.idle(now);
        match idle.map_or(Some(LONGEST_LOCK), |idle| LONGEST_LOCK.checked_sub(idle)) {
            Some(left) if !left.is_zero() => {
                let session = held.session;
                let until = now + left;
                *lock(&self.held) = Some(Held { session, until });
            }
            Some(_) | None => self.free(),
        }
    }

    async fn watch(self) {
        let mut changed = self.changed.subscribe();
        let mut holder = self.authority.holder();
        loop {
            let held = lock(&self.held).clone();
            let Some(held) = held else {
                if changed.changed().await.is_err() {
                    return;
                }
                continue;
            };
            let is_another =
                |now: &Option<SkillOwner>| *now != Some(SkillOwner::Session(held.session));
            // Dropping the returned reference unlocks the watch channel, so that the holder can
            // change.
            let gone = async { drop(holder.wait_for(is_another).await) };
            tokio::select! {
                renewed = changed.changed() => if renewed.is_err() { return },
                () = sleep_until(held.until) => self.end_or_extend(&held),
                () = gone => self.free(),
            }
        }
    }

    fn show(&self, by: Option<(&str, &str)>) {
        let (client, user) = by.unwrap_or_default();
        let remaining = if by.is_some() {
            LONGEST_LOCK
        } else {
            Duration::ZERO
        };
        let values = [
            ("Locked", Variant::from(by.is_some())),
            ("LockingClient", Variant::from(client)),
            ("LockingUser", Variant::from(user)),
            (
                "RemainingLockTime",
                Variant::from(remaining.as_secs_f64() * 1_000.0),
            ),
        ];
        for (name, value) in values {
            if let Some(node) = self.object.node(name) {
                // The node exists as long as the server.
                let _shown = self.server.show(node, value);
            }
        }
    }
}

type Answer = Result<i32, StatusCode>;

/// Return values of the methods (OPC 10000-100, 7.4 and following).
const DONE: i32 = 0;
const ALREADY_LOCKED: i32 = -1;
const NOT_LOCKED: i32 = -1;
/// MaxInactiveLockTime: a lock that is not renewed ends after this time.
const LONGEST_LOCK: Duration = Duration::from_secs(600);
