use std::sync::atomic::AtomicUsize;
use std::task::Wake;

use super::*;

/// A network in memory. It returns each message to all its members, the sender included.
#[derive(Debug, Clone, Default)]
struct Wire(Arc<Mutex<Vec<Ether>>>);

type Ether = Arc<Mutex<VecDeque<(Vec<u8>, SocketAddr)>>>;

#[derive(Debug)]
struct Memory {
    wire: Wire,
    received: Ether,
    sender: SocketAddr,
    companions: Vec<SocketAddr>,
    refuses: bool,
}

impl Wire {
    fn attach(&self, port: u16) -> Memory {
        let received = Ether::default();
        self.0.lock().unwrap().push(Arc::clone(&received));
        Memory {
            wire: self.clone(),
            received,
            sender: SocketAddr::from(([10, 0, 0, 1], port)),
            companions: Vec::new(),
            refuses: false,
        }
    }

    fn send(&self, bytes: &[u8], from: SocketAddr) {
        for member in self.0.lock().unwrap().iter() {
            member.lock().unwrap().push_back((bytes.to_vec(), from));
        }
    }
}

impl Carrier for Memory {
    fn try_send(&mut self, message: &OutgoingMessage<'_>) -> Result<(), SendError> {
        if self.refuses {
            return Err(SendError::Unreachable);
        }
        self.wire.send(message.bytes, self.sender);
        Ok(())
    }

    fn poll_recv(
        &mut self,
        _: &mut Context<'_>,
        buffer: &mut Vec<u8>,
    ) -> Poll<io::Result<Received>> {
        self.try_recv(buffer).map_or(Poll::Pending, Poll::Ready)
    }

    fn try_recv(&mut self, buffer: &mut Vec<u8>) -> Option<io::Result<Received>> {
        let (bytes, from) = self.received.lock().unwrap().pop_front()?;
        let length = bytes.len();
        buffer[..length].copy_from_slice(&bytes);
        Some(Ok(Received {
            length,
            from,
            stamp: None,
        }))
    }

    fn follow(&mut self) -> Option<CarrierChange> {
        None
    }

    fn lost(&self) -> Option<String> {
        None
    }

    fn source(&self) -> Option<SocketAddr> {
        Some(self.sender)
    }

    fn interface(&self) -> String {
        "memory".to_owned()
    }

    fn senders(&self) -> Senders {
        Senders::Addresses
    }
}

impl HubNetwork for Memory {
    fn drop_companions(&mut self, companions: Vec<SocketAddr>) {
        self.companions = companions;
    }

    fn is_companion(&self, from: SocketAddr) -> bool {
        self.companions.contains(&from)
    }

    fn sender(&self) -> SocketAddr {
        self.sender
    }

    fn seen_source(&self) -> SocketAddr {
        self.sender
    }
}

fn group(port: u16) -> HubGroup {
    HubGroup::Udp {
        address: SocketAddr::from(([239, 0, 0, 1], port)),
        interface: None,
    }
}

/// Returns two carriers of a hub, and a member of the same network outside of the process.
fn two_and_a_stranger() -> ([InProcess<Memory>; 2], Memory, Wire) {
    let (hub, wire) = (ProcessHub::default(), Wire::default());
    let two = [1, 2].map(|port| InProcess::new(&hub, wire.attach(port), group(4840)));
    (two, wire.attach(9), wire)
}

/// Returns everything that a carrier receives, with the ports of the senders.
fn received(carrier: &mut dyn Carrier) -> Vec<(Vec<u8>, u16)> {
    let mut buffer = vec![0; 64];
    let mut all = Vec::new();
    while let Some(received) = carrier.try_recv(&mut buffer) {
        let Received { length, from, .. } = received.unwrap();
        all.push((buffer[..length].to_vec(), from.port()));
    }
    all
}

fn sent(bytes: &[u8], port: u16) -> (Vec<u8>, u16) {
    (bytes.to_vec(), port)
}

#[test]
fn everyone_receives_a_message_once() {
    let ([mut one, mut two], mut stranger, wire) = two_and_a_stranger();
    one.try_send(&OutgoingMessage::new(b"a")).unwrap();
    let more = [OutgoingMessage::new(b"b"), OutgoingMessage::new(b"c")];
    assert!(two.try_send_all(&more).is_empty());
    wire.send(b"d", SocketAddr::from(([10, 0, 0, 9], 9)));
    // An own message that the network returns is left to the caller's loop rule.
    assert_eq!(
        received(&mut one),
        [sent(b"b", 2), sent(b"a", 1), sent(b"c", 2), sent(b"d", 9)]
    );
    assert_eq!(
        received(&mut two),
        [sent(b"a", 1), sent(b"b", 2), sent(b"c", 2), sent(b"d", 9)]
    );
    let all = [sent(b"a", 1), sent(b"b", 2), sent(b"c", 2), sent(b"d", 9)];
    assert_eq!(received(&mut stranger), all);
}

#[test]
fn a_message_that_the_network_refuses_reaches_nobody() {
    let ([mut one, mut two], mut stranger, _) = two_and_a_stranger();
    one.network.refuses = true;
    let refused = one.try_send(&OutgoingMessage::new(b"a"));
    assert_eq!(refused, Err(SendError::Unreachable));
    let errors = one.try_send_all(&[OutgoingMessage::new(b"b"), OutgoingMessage::new(b"c")]);
    assert_eq!(errors.len(), 2);
    assert_eq!(
        (received(&mut two), received(&mut stranger)),
        (vec![], vec![])
    );
}

#[test]
fn a_member_that_does_not_read_loses_its_own_messages_only_and_they_are_counted() {
    let ([mut one, mut two], stranger, _) = two_and_a_stranger();
    let large = vec![7; 60_000];
    let fit = MOST_BYTES / large.len();
    for _ in 0..fit + 3 {
        one.try_send(&OutgoingMessage::new(&large)).unwrap();
    }
    assert_eq!((one.overflowed(), two.overflowed()), (0, 3));
    assert_eq!(two.overflowed(), 0);
    stranger.received.lock().unwrap().clear();
    two.network.received.lock().unwrap().clear();
    let mut buffer = vec![0; crate::BUFFER];
    let mut count = 0;
    while two.try_recv(&mut buffer).is_some() {
        count += 1;
    }
    assert_eq!(count, fit);
    one.try_send(&OutgoingMessage::new(b"again")).unwrap();
    assert_eq!(received(&mut two), [sent(b"again", 1)]);
}

#[test]
fn neither_the_network_nor_the_process_keeps_the_other_waiting() {
    let ([mut one, mut two], _stranger, wire) = two_and_a_stranger();
    for _ in 0..10 {
        one.try_send(&OutgoingMessage::new(b"inside")).unwrap();
    }
    // The copies that the network returns.
    two.network.received.lock().unwrap().clear();
    for _ in 0..10 {
        wire.send(b"outside", SocketAddr::from(([10, 0, 0, 9], 9)));
    }
    let ports: Vec<u16> = received(&mut two)
        .into_iter()
        .map(|(_, port)| port)
        .collect();
    assert_eq!(ports[..6], [1, 9, 1, 9, 1, 9]);
    assert_eq!(ports.len(), 20);
}

#[test]
fn a_message_behind_many_datagrams_of_the_process_is_received_at_once() {
    let ([_one, mut two], _stranger, wire) = two_and_a_stranger();
    // The kernel does not filter them.
    for _ in 0..1_000 {
        wire.send(b"inside", SocketAddr::from(([10, 0, 0, 1], 1)));
    }
    wire.send(b"heartbeat", SocketAddr::from(([10, 0, 0, 9], 9)));
    assert_eq!(received(&mut two), [sent(b"heartbeat", 9)]);
}

#[derive(Default)]
struct Count(AtomicUsize);

impl Wake for Count {
    fn wake(self: Arc<Self>) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }
}

#[test]
fn a_waiting_receiver_is_woken_by_another_thread() {
    let ([mut one, mut two], _stranger, _) = two_and_a_stranger();
    let wakes = Arc::<Count>::default();
    let waker = Waker::from(Arc::clone(&wakes));
    let mut buffer = vec![0; 64];
    let mut cx = Context::from_waker(&waker);
    assert!(two.poll_recv(&mut cx, &mut buffer).is_pending());
    std::thread::scope(|scope| {
        scope.spawn(|| one.try_send(&OutgoingMessage::new(b"a")).unwrap());
    });
    assert_eq!(wakes.0.load(Ordering::Relaxed), 1);
    let Poll::Ready(Ok(Received { length, from, .. })) = two.poll_recv(&mut cx, &mut buffer) else {
        panic!("no message");
    };
    assert_eq!((&buffer[..length], from.port()), (&b"a"[..], 1));
    // The copy of the network is not received, so the receiver waits again.
    assert!(two.poll_recv(&mut cx, &mut buffer).is_pending());
}

#[test]
fn members_of_different_groups_do_not_meet() {
    let (hub, wire) = (ProcessHub::default(), Wire::default());
    let mut one = InProcess::new(&hub, wire.attach(1), group(4840));
    let mut other = InProcess::new(&hub, Wire::default().attach(2), group(4841));
    one.try_send(&OutgoingMessage::new(b"a")).unwrap();
    assert_eq!(received(&mut other), []);
    assert!(other.network.companions.is_empty());
}

#[test]
fn a_sender_that_changes_or_leaves_is_followed() {
    let ([mut one, mut two], _stranger, wire) = two_and_a_stranger();
    one.network.sender.set_port(77);
    assert_eq!(one.follow(), None);
    one.try_send(&OutgoingMessage::new(b"new")).unwrap();
    assert_eq!(received(&mut two), [sent(b"new", 77)]);
    // Another program of this host gets the previous port.
    wire.send(b"foreign", SocketAddr::from(([10, 0, 0, 1], 1)));
    assert_eq!(received(&mut two), [sent(b"foreign", 1)]);
    drop(one);
    wire.send(b"later", SocketAddr::from(([10, 0, 0, 1], 77)));
    assert_eq!(received(&mut two), [sent(b"later", 77)]);
}
