//! Tests calls of other spaces as services of the graph.

use std::sync::Arc;
use std::time::Duration;

use bridge_node::{
    AskError, AskErrorKind, AskId, CallDescription, CallField, CallRole, Port, PortEvent,
};
use bytes::Bytes;
use messages::{Dialect, TypeRegistry};
use tcpros::{ServiceClient, ServiceClientOptions, ServiceError};
use uadp::{BuiltinType, StatusCode};

use crate::{Cell, NOTHING, cell, id, within};

const START: &str = "ua_0_7_105";
/// `TriggerResponse(True, "ok")`.
const FINE: &[u8] = &[1, 2, 0, 0, 0, b'o', b'k'];

fn start() -> Arc<CallDescription> {
    Arc::new(CallDescription {
        name: "gripper.Grasp.Start".to_owned(),
        about: String::new(),
        role: CallRole::Call,
        request: Vec::new(),
        response: vec![
            CallField::scalar("success", BuiltinType::Boolean),
            CallField::scalar("message", BuiltinType::String),
            CallField::scalar("run", BuiltinType::UInt32),
        ],
    })
}

/// Returns a service client of the robot for the call.
fn client(cell: &Cell) -> ServiceClient {
    let name = "std_srvs/Trigger";
    let found = TypeRegistry::bundle(Dialect::Ros1).service(&name.parse().unwrap());
    let options = ServiceClientOptions {
        md5sum: Some(found.unwrap().md5().to_owned()),
        type_name: Some(name.to_owned()),
        timeout: Duration::from_secs(5),
        ..ServiceClientOptions::default()
    };
    let client = cell.node.service_client(&format!("/{START}"), options);
    client.unwrap()
}

/// Calls until the service is available, and runs the port until it receives the request.
async fn asked(cell: &mut Cell, client: &ServiceClient) -> (AskId, Asking) {
    let caller = client.clone();
    let asking = tokio::spawn(async move {
        loop {
            match caller.call(Bytes::new()).await {
                Err(ServiceError::NotAdvertised { .. }) => {
                    tokio::time::sleep(Duration::from_millis(20)).await;
                }
                ended => return ended,
            }
        }
    });
    let ask = within("the question", async {
        loop {
            if let PortEvent::Ask {
                ask,
                topic,
                request,
                ..
            } = cell.port.recv().await
            {
                assert_eq!((topic, &request[..]), (id(START), &b""[..]));
                return ask;
            }
        }
    });
    (ask.await, asking)
}

type Asking = tokio::task::JoinHandle<Result<Bytes, ServiceError>>;

#[tokio::test]
async fn a_call_is_a_service_whose_answers_and_faults_reach_who_called() {
    let mut cell = cell(NOTHING);
    cell.port.call_known(id(START), &start());
    let bound = cell.port.recv().await;
    assert!(matches!(
        bound,
        PortEvent::CallBound { topic, service_type, .. }
            if topic == id(START) && service_type.name().to_string() == "std_srvs/Trigger"
    ));
    let client = client(&cell);
    let (ask, answer) = asked(&mut cell, &client).await;
    cell.port
        .answered(ask, id(START), Ok(Bytes::from_static(FINE)));
    assert_eq!(answer.await.unwrap().unwrap(), FINE);
    let (ask, answer) = asked(&mut cell, &client).await;
    let unknown = AskError {
        kind: AskErrorKind::Unknown,
        status: StatusCode::GOOD,
        text: "nobody knows whether it was executed".to_owned(),
    };
    cell.port.answered(ask, id(START), Err(unknown));
    let fault = answer.await.unwrap().unwrap_err().to_string();
    assert!(fault.contains("nobody knows"), "{fault}");
}

#[tokio::test]
async fn a_service_goes_with_its_call_after_who_waits_was_told() {
    let mut cell = cell(NOTHING);
    cell.port.call_known(id(START), &start());
    let client = client(&cell);
    let (_, answer) = asked(&mut cell, &client).await;
    cell.port.call_gone(id(START));
    let answer = beside(&mut cell, answer).await;
    let fault = answer.unwrap().unwrap_err().to_string();
    assert!(fault.contains("unknown whether"), "{fault}");
    let gone = async {
        while !matches!(
            client.call(Bytes::new()).await,
            Err(ServiceError::NotAdvertised { .. })
        ) {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    within("the service to go", beside(&mut cell, gone)).await;
}

/// Runs the port until the future completes.
async fn beside<T>(cell: &mut Cell, future: impl Future<Output = T>) -> T {
    let run = async {
        loop {
            drop::<PortEvent>(cell.port.recv().await);
        }
    };
    tokio::select! {
        done = future => done,
        () = run => panic!("the port has no end"),
    }
}
