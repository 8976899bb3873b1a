//! Fuzzes mDNS packets, texts of records, and URLs with arbitrary bytes.

use crate::input::Input;

/// Decodes a packet. Received names are short and printable, and a URL is formatted as it was
/// parsed.
pub fn mdns(packet: &[u8]) {
    let gone = discovery::fuzz::goodbyes(packet);
    assert!(gone.len() <= packet.len() / 12, "{} names", gone.len());
    for name in &gone {
        assert!(shown(name) && name.len() <= 63, "{name:?}");
    }
    let mut input = Input::new(packet);
    let (port, instance) = (input.u16(), input.bytes());
    let (path, capabilities) = (input.bytes(), input.bytes());
    let instance = String::from_utf8_lossy(instance);
    if let Some(heard) = discovery::fuzz::heard(&instance, port, path, capabilities) {
        assert!(shown(&heard.instance) && heard.instance.len() <= 63);
        assert!(shown(&heard.url), "{:?}", heard.url);
        assert!(discovery::fuzz::url(&heard.url).is_some(), "{}", heard.url);
        assert!(heard.capabilities.len() <= 32);
        for code in &heard.capabilities {
            assert!(shown(code) && code.len() <= 32, "{code:?}");
        }
    }
    let text = String::from_utf8_lossy(packet);
    for text in [text.as_ref(), &format!("opc.tcp://{text}")] {
        if let Some(url) = discovery::fuzz::url(text) {
            assert!(shown(&url), "{url:?}");
            assert_eq!(discovery::fuzz::url(&url), Some(url), "of {text:?}");
        }
    }
}

fn shown(text: &str) -> bool {
    !text.is_empty() && !text.contains(char::is_control)
}
