//! XML-RPC as used by ROS 1: calls, responses and faults as text.
//!
//! The reader accepts the specification and the extensions of ROS peers (`<value>` without a type,
//! `<nil/>`, `<i8>`), and refuses everything else with the position of the error. It does not read
//! DTDs, so there are no entities to expand, and it limits nesting. The caller has to limit the
//! size of a document.

mod reader;
mod writer;

use thiserror::Error;

use self::reader::XmlReader;
use self::writer::{escape, write_value};

/// An XML-RPC value.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum XmlRpcValue {
    /// `<i4>` and `<int>`; also `<i8>` where the number fits.
    Int(i32),
    /// `<boolean>`, `0` or `1` on the wire.
    Bool(bool),
    /// `<double>`.
    Double(f64),
    /// `<string>`, or text directly in `<value>`.
    String(String),
    /// `<dateTime.iso8601>`, unparsed.
    DateTime(String),
    /// `<base64>`, decoded.
    Binary(Vec<u8>),
    /// `<array>`.
    Array(Vec<Self>),
    /// `<struct>`, members in the order of the document.
    Struct(Vec<(String, Self)>),
    /// `<nil/>`.
    Nil,
}

impl XmlRpcValue {
    /// Returns the text of a string value.
    pub(crate) fn as_str(&self) -> Option<&str> {
        if let Self::String(text) = self {
            Some(text)
        } else {
            None
        }
    }

    /// Returns the number of an integer value; a boolean counts as 0 or 1, because some peers write
    /// status codes as booleans.
    pub(crate) fn as_int(&self) -> Option<i32> {
        match self {
            Self::Int(number) => Some(*number),
            Self::Bool(flag) => Some(i32::from(*flag)),
            Self::Double(_)
            | Self::String(_)
            | Self::DateTime(_)
            | Self::Binary(_)
            | Self::Array(_)
            | Self::Struct(_)
            | Self::Nil => None,
        }
    }

    /// Returns the elements of an array value.
    pub(crate) fn as_array(&self) -> Option<&[Self]> {
        if let Self::Array(items) = self {
            Some(items)
        } else {
            None
        }
    }
}

impl From<&str> for XmlRpcValue {
    fn from(text: &str) -> Self {
        Self::String(text.to_owned())
    }
}

impl From<String> for XmlRpcValue {
    fn from(text: String) -> Self {
        Self::String(text)
    }
}

impl From<i32> for XmlRpcValue {
    fn from(number: i32) -> Self {
        Self::Int(number)
    }
}

impl From<Vec<Self>> for XmlRpcValue {
    fn from(items: Vec<Self>) -> Self {
        Self::Array(items)
    }
}

/// A method call.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct MethodCall {
    /// Name of the method.
    pub(crate) method: String,
    /// Arguments in order.
    pub(crate) params: Vec<XmlRpcValue>,
}

impl MethodCall {
    /// Reads a `<methodCall>` document.
    pub(crate) fn parse(document: &[u8]) -> Result<Self, XmlError> {
        let mut reader = XmlReader::new(document)?;
        reader.open("methodCall")?;
        reader.open("methodName")?;
        let method = reader.text()?.trim().to_owned();
        reader.close("methodName")?;
        let params = reader.params()?;
        reader.close("methodCall")?;
        reader.end()?;
        Ok(Self { method, params })
    }

    /// Returns the call as a document.
    pub(crate) fn encode(&self) -> String {
        let mut out = String::from("<?xml version=\"1.0\"?>\n<methodCall><methodName>");
        escape(&self.method, &mut out);
        out.push_str("</methodName><params>");
        for param in &self.params {
            out.push_str("<param>");
            write_value(param, &mut out);
            out.push_str("</param>");
        }
        out.push_str("</params></methodCall>\n");
        out
    }
}

/// A `<fault>` response.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error("fault {code}: {message}")]
pub struct XmlRpcFault {
    /// `faultCode`.
    pub code: i32,
    /// `faultString`.
    pub message: String,
}

/// The result of a method call.
pub(crate) type MethodResponse = Result<XmlRpcValue, XmlRpcFault>;

/// Reads a `<methodResponse>` document.
pub(crate) fn parse_response(document: &[u8]) -> Result<MethodResponse, XmlError> {
    let mut reader = XmlReader::new(document)?;
    reader.open("methodResponse")?;
    let response = if reader.at_open("fault")? {
        reader.open("fault")?;
        let value = reader.value(0)?;
        reader.close("fault")?;
        Err(fault_of(&value))
    } else {
        let mut params = reader.params()?;
        if params.len() != 1 {
            return Err(XmlError::Content {
                expected: "one result",
                at: reader.position(),
            });
        }
        Ok(params.pop().unwrap_or(XmlRpcValue::Nil))
    };
    reader.close("methodResponse")?;
    reader.end()?;
    Ok(response)
}

/// Returns a response as a document.
pub(crate) fn encode_response(response: &MethodResponse) -> String {
    let mut out = String::from("<?xml version=\"1.0\"?>\n<methodResponse>");
    match response {
        Ok(value) => {
            out.push_str("<params><param>");
            write_value(value, &mut out);
            out.push_str("</param></params>");
        }
        Err(fault) => {
            out.push_str("<fault>");
            let members = vec![
                ("faultCode".to_owned(), XmlRpcValue::Int(fault.code)),
                (
                    "faultString".to_owned(),
                    XmlRpcValue::String(fault.message.clone()),
                ),
            ];
            write_value(&XmlRpcValue::Struct(members), &mut out);
            out.push_str("</fault>");
        }
    }
    out.push_str("</methodResponse>\n");
    out
}

/// Error in a document. Positions are byte offsets.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum XmlError {
    /// Not UTF-8, which is the only encoding ROS peers use.
    #[error("the document is not UTF-8")]
    NotUtf8,
    /// A tag is missing or not allowed here.
    #[error("expected {expected} at byte {at}")]
    Tag {
        /// The expected tag.
        expected: &'static str,
        /// Position of the error.
        at: usize,
    },
    /// The text inside a tag is invalid for its type.
    #[error("expected {expected} before byte {at}")]
    Content {
        /// The expected content.
        expected: &'static str,
        /// Position of the end of the text.
        at: usize,
    },
    /// The document ends inside an element.
    #[error("the document ends inside {0}")]
    Truncated(&'static str),
    /// Arrays and structs are nested deeper than ROS uses.
    #[error("values are nested more than {MAX_DEPTH} deep")]
    TooDeep,
}

fn fault_of(value: &XmlRpcValue) -> XmlRpcFault {
    let mut fault = XmlRpcFault {
        code: 0,
        message: String::new(),
    };
    if let XmlRpcValue::Struct(members) = value {
        for (name, member) in members {
            match name.as_str() {
                "faultCode" => fault.code = member.as_int().unwrap_or(0),
                "faultString" => member.as_str().unwrap_or("").clone_into(&mut fault.message),
                _ => {}
            }
        }
    }
    fault
}

const MAX_DEPTH: usize = 32;

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn value_of(inner: &str) -> Result<XmlRpcValue, XmlError> {
        let document = format!(
            "<?xml version='1.0'?><methodResponse><params><param>{inner}</param></params></methodResponse>"
        );
        parse_response(document.as_bytes()).map(|response| response.unwrap())
    }

    #[test]
    fn a_call_of_xmlrpc_plus_plus_reads_as_it_was_meant() {
        let document = b"<?xml version=\"1.0\"?>\r\n<methodCall><methodName>requestTopic</methodName>\r\n\
            <params><param><value>/relay</value></param><param><value>/a&amp;b</value></param><param><value><array><data>\
            <value><array><data><value>TCPROS</value></data></array></value></data></array></value></param></params></methodCall>\r\n";
        let call = MethodCall::parse(document).unwrap();
        assert_eq!(call.method, "requestTopic");
        assert_eq!(
            call.params,
            [
                "/relay".into(),
                "/a&b".into(),
                XmlRpcValue::Array(vec![XmlRpcValue::Array(vec!["TCPROS".into()])])
            ]
        );
    }

    #[test]
    fn every_type_reads_from_its_tag() {
        assert_eq!(
            value_of("<value><int> -7 </int></value>"),
            Ok(XmlRpcValue::Int(-7))
        );
        assert_eq!(
            value_of("<value><i4>+7</i4></value>"),
            Ok(XmlRpcValue::Int(7))
        );
        assert_eq!(
            value_of("<value><boolean>1</boolean></value>"),
            Ok(XmlRpcValue::Bool(true))
        );
        assert_eq!(
            value_of("<value><double>-1.5e3</double></value>"),
            Ok(XmlRpcValue::Double(-1500.0))
        );
        assert_eq!(value_of("<value><nil/></value>"), Ok(XmlRpcValue::Nil));
        assert_eq!(value_of("<value/>"), Ok("".into()));
        assert_eq!(value_of("<value></value>"), Ok("".into()));
        assert_eq!(value_of("<value> a </value>"), Ok(" a ".into()));
        assert_eq!(value_of("<value>\n <string/>\n</value>"), Ok("".into()));
        assert_eq!(
            value_of("<value><string>&lt;&#65;&#x42;<![CDATA[<&]]></string></value>"),
            Ok("<AB<&".into())
        );
        assert_eq!(
            value_of("<value><base64>AP8Q\n/w==</base64></value>"),
            Ok(XmlRpcValue::Binary(vec![0, 255, 16, 255]))
        );
        assert_eq!(
            value_of("<value><array><data/></array></value>"),
            Ok(XmlRpcValue::Array(vec![]))
        );
        assert_eq!(
            value_of(
                "<value><struct><member><name>a</name><value>b</value></member></struct></value>"
            ),
            Ok(XmlRpcValue::Struct(vec![("a".to_owned(), "b".into())]))
        );
    }

    #[test]
    fn what_is_not_xmlrpc_is_refused_with_its_place() {
        let at = |inner: &str| value_of(inner).unwrap_err();
        assert!(matches!(
            at("<value><i4>2147483648</i4></value>"),
            XmlError::Content {
                expected: "a 32 bit integer",
                ..
            }
        ));
        assert!(matches!(
            at("<value><boolean>true</boolean></value>"),
            XmlError::Content {
                expected: "0 or 1",
                ..
            }
        ));
        assert!(matches!(
            at("<value><i4>1</int></value>"),
            XmlError::Tag {
                expected: "the closing tag",
                ..
            }
        ));
        assert!(matches!(
            at("<value><float>1</float></value>"),
            XmlError::Tag {
                expected: "a type of XML-RPC",
                ..
            }
        ));
        assert!(matches!(
            at("<value>&unknown;</value>"),
            XmlError::Content {
                expected: "a known reference",
                ..
            }
        ));
        assert!(matches!(
            at("<value>&#xD800;</value>"),
            XmlError::Content { .. }
        ));
        assert!(matches!(
            at("<value><base64>A===</base64></value>"),
            XmlError::Content {
                expected: "base64",
                ..
            }
        ));
        assert_eq!(
            MethodCall::parse(b"<methodCall><methodName>x"),
            Err(XmlError::Truncated("a text"))
        );
        assert_eq!(MethodCall::parse(b"\xff"), Err(XmlError::NotUtf8));
        let deep = format!(
            "{}{}",
            "<value><array><data>".repeat(40),
            "</data></array></value>".repeat(40)
        );
        assert_eq!(at(&deep), XmlError::TooDeep);
    }

    #[test]
    fn a_fault_comes_out_as_a_fault() {
        let fault = XmlRpcFault {
            code: -1,
            message: "no <such> method".to_owned(),
        };
        let document = encode_response(&Err(fault.clone()));
        assert_eq!(parse_response(document.as_bytes()), Ok(Err(fault)));
    }

    fn any_value() -> impl Strategy<Value = XmlRpcValue> {
        let leaf = prop_oneof![
            any::<i32>().prop_map(XmlRpcValue::Int),
            any::<bool>().prop_map(XmlRpcValue::Bool),
            (-1e300..1e300).prop_map(XmlRpcValue::Double),
            "[^\\x00-\\x08\\x0b\\x0c\\x0e-\\x1f\u{fffe}\u{ffff}]*".prop_map(XmlRpcValue::String),
            prop::collection::vec(any::<u8>(), 0..40).prop_map(XmlRpcValue::Binary),
            Just(XmlRpcValue::Nil),
        ];
        leaf.prop_recursive(4, 32, 4, |inner| {
            prop_oneof![
                prop::collection::vec(inner.clone(), 0..4).prop_map(XmlRpcValue::Array),
                prop::collection::vec(("[a-z<&>]{0,6}", inner), 0..4).prop_map(XmlRpcValue::Struct),
            ]
        })
    }

    proptest! {
        #[test]
        fn a_written_call_reads_back_equal(method in "[a-zA-Z]{1,12}", params in prop::collection::vec(any_value(), 0..4)) {
            let call = MethodCall { method, params };
            prop_assert_eq!(MethodCall::parse(call.encode().as_bytes()), Ok(call));
        }

        #[test]
        fn a_prefix_of_a_call_is_an_error(params in prop::collection::vec(any_value(), 0..3), cut in any::<prop::sample::Index>()) {
            let document = MethodCall { method: "m".to_owned(), params }.encode();
            let document = document.trim_end().as_bytes();
            prop_assert!(MethodCall::parse(&document[..cut.index(document.len())]).is_err());
        }

        #[test]
        fn random_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
            prop_assert!(MethodCall::parse(&bytes).is_err());
        }

        #[test]
        fn random_tags_never_panic(text in "(<(/)?(methodCall|methodName|params|param|value|array|data|struct|member|name|i4|base64)(/)?>|[a&;#<>!\\[\\]-]){0,60}") {
            // The call may be well formed by chance; reading has to end in a value or an error.
            if let Ok(call) = MethodCall::parse(text.as_bytes()) {
                prop_assert_eq!(MethodCall::parse(call.encode().as_bytes()), Ok(call));
            }
        }
    }
}
