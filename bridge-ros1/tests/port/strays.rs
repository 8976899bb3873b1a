//! Tests more unknown values of other spaces than are published.

use super::*;

const WITHOUT_BINDING: &str = "
spaces:
  - {id: 1}
  - {id: 2}
namespaces:
  2: urn:test
variables:
  - {node: ns=2;i=3, name: Park, type: Boolean, origin: 2}
";
/// Two values have no standard type, so their topic is not registered at the master.
const NO_TYPE: [(BuiltinType, bool); 2] = [(BuiltinType::Double, false); 2];
const BOOLEAN: [(BuiltinType, bool); 1] = [(BuiltinType::Boolean, false)];

fn made_up(number: u16) -> TopicId {
    TopicId::new(9, 1, number + 1).unwrap()
}

#[tokio::test]
async fn made_up_values_keep_out_none_of_the_mapping_and_give_way_when_they_fall_silent() {
    let mut cell = cell(WITHOUT_BINDING);
    let port = &mut cell.port;
    for number in 0..4100 {
        port.wanted(made_up(number), &NO_TYPE, None);
    }
    let refused =
        "1 too_many_topics values without an entry in the mapping and without a subscriber";
    assert_eq!(events(port, 4).await, [refused; 4]);
    port.wanted(id("ua_2_2_3"), &BOOLEAN, None);
    let bound = "ua_2_2_3 is std_msgs/Bool whole";
    assert_eq!(events(port, 1).await, [bound]);

    port.wanted(id("ua_2_2_4"), &BOOLEAN, None);
    assert_eq!(events(port, 1).await, [refused]);
    port.silent(made_up(7), true);
    // The Router repeats the request while values arrive; there is room after the next search for
    // silent values.
    let gave_way = within("room", async {
        loop {
            port.wanted(id("ua_2_2_4"), &BOOLEAN, None);
            let event = line(&port.recv().await);
            if event != refused {
                return event;
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    })
    .await;
    assert_eq!(gave_way, "ua_9_1_8 unbound");
    let bound = "ua_2_2_4 is std_msgs/Bool whole";
    assert_eq!(events(port, 1).await, [bound]);
}
