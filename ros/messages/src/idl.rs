//! The parser of `.idl` texts, as far as rosidl writes and reads them: modules, structs, typedefs
//! and constants.
//!
//! Types are converted to the notation of `.msg` files, so that both languages give the same
//! definitions with the same hashes.

use std::collections::HashMap;

use crate::definition::{DefinitionLine, MessageDefinition};
use crate::{DefinitionError, Dialect, TextKind, TypeName};

/// Parses the structs of one ROS type: one of a message, two of a service, or three of an action.
///
/// # Errors
/// [`DefinitionError::Syntax`], also if a struct is missing.
pub(crate) fn definitions<const N: usize>(
    kind: TextKind,
    name: &TypeName,
    text: &str,
    parts: [(&str, TypeName); N],
) -> Result<[MessageDefinition; N], DefinitionError> {
    let refused = |fault: Fault| DefinitionError::Syntax {
        name: name.clone(),
        line: fault.line,
        reason: fault.reason,
        text: fault.text.chars().take(200).collect(),
    };
    let mut parser = Parser {
        tokens: tokens(text).map_err(refused)?,
        at: 0,
        scope: Vec::new(),
        typedefs: HashMap::new(),
        structs: HashMap::new(),
        constants: HashMap::new(),
    };
    parser.specification().map_err(refused)?;
    let mut found = Vec::new();
    for (suffix, made) in parts {
        let scope = format!("{}::{}", name.package(), kind.word());
        let path = format!("{scope}::{}{suffix}", name.name());
        let Some(mut fields) = parser.structs.remove(&path) else {
            return Err(DefinitionError::Syntax {
                name: name.clone(),
                line: text.lines().count(),
                reason: "expected the struct of this name in the modules of its package and kind",
                text: path,
            });
        };
        // The member that rosidl adds to an empty message.
        if let [only] = fields.as_slice()
            && only.name == "structure_needs_at_least_one_member"
        {
            fields.clear();
        }
        let constants = parser.constants.remove(&format!("{path}_Constants"));
        let constants = constants.unwrap_or_default();
        found.push(MessageDefinition::of_lines(
            Dialect::Ros2,
            &made,
            constants,
            fields,
        )?);
    }
    let count = text.lines().count();
    found.try_into().map_err(|_| DefinitionError::Syntax {
        name: name.clone(),
        line: count,
        reason: "expected a struct for each part",
        text: String::new(),
    })
}

struct Parser<'t> {
    tokens: Vec<Token<'t>>,
    at: usize,
    /// The enclosing modules.
    scope: Vec<&'t str>,
    typedefs: HashMap<String, Type>,
    structs: HashMap<String, Vec<DefinitionLine>>,
    constants: HashMap<String, Vec<DefinitionLine>>,
}

#[derive(Clone, Copy, Debug)]
struct Token<'t> {
    kind: TokenKind,
    text: &'t str,
    line: usize,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum TokenKind {
    Word,
    Number,
    /// Includes its quotes.
    Quoted,
    Mark,
}

/// A type in the notation of `.msg` files, split into base and length.
#[derive(Clone, Debug)]
struct Type {
    base: String,
    /// The length, such as `[3]`, `[]` or `[<=3]`.
    arity: Option<String>,
}

impl Type {
    fn written(&self) -> String {
        format!("{}{}", self.base, self.arity.as_deref().unwrap_or_default())
    }
}

struct Fault {
    line: usize,
    reason: &'static str,
    text: String,
}

type Parsed<T> = Result<T, Fault>;

impl<'t> Parser<'t> {
    fn specification(&mut self) -> Parsed<()> {
        while let Some(token) = self.peek() {
            match token.text {
                "}" if !self.scope.is_empty() => {
                    self.at += 1;
                    self.scope.pop();
                    self.expect(";")?;
                }
                "@" => self.annotation()?,
                "module" => {
                    self.at += 1;
                    let name = self.word()?;
                    if self.scope.len() >= DEEPEST {
                        return Err(fault(token, "modules nested deeper than 16"));
                    }
                    self.scope.push(name);
                    self.expect("{")?;
                }
                "typedef" => self.typedef()?,
                "const" => self.constant()?,
                "struct" => self.structure()?,
                _ => {
                    return Err(fault(
                        token,
                        "expected `module`, `struct`, `typedef` or `const`: ROS supports no other parts of IDL",
                    ));
                }
            }
        }
        if self.scope.is_empty() {
            Ok(())
        } else {
            Err(self.ended())
        }
    }

    fn structure(&mut self) -> Parsed<()> {
        self.at += 1;
        let name = self.word()?;
        let token = self.next()?;
        if token.text != "{" {
            return Err(fault(token, "expected `{`: structs in ROS cannot inherit"));
        }
        let mut fields = Vec::new();
        loop {
            match self.peek().map(|token| token.text) {
                Some("@") => self.annotation()?,
                Some("}") => break,
                _ => self.members(&mut fields)?,
            }
        }
        self.at += 1;
        self.expect(";")?;
        let path = self.path(name);
        self.structs.insert(path, fields);
        Ok(())
    }

    /// Parses `type name;` or `type one, two[3];`.
    fn members(&mut self, fields: &mut Vec<DefinitionLine>) -> Parsed<()> {
        let kind = self.type_spec()?;
        loop {
            let token = self.peek().ok_or_else(|| self.ended())?;
            let name = self.word()?;
            let kind = self.declarator(&kind)?;
            fields.push(DefinitionLine {
                number: token.line,
                written: kind.written(),
                name: name.to_owned(),
                value: None,
            });
            let next = self.next()?;
            match next.text {
                "," => {}
                ";" => return Ok(()),
                _ => return Err(fault(next, "`;` expected")),
            }
        }
    }

    fn typedef(&mut self) -> Parsed<()> {
        self.at += 1;
        let kind = self.type_spec()?;
        let name = self.word()?;
        let kind = self.declarator(&kind)?;
        self.expect(";")?;
        let path = self.path(name);
        self.typedefs.insert(path, kind);
        Ok(())
    }

    /// Parses the length of a fixed array after the name of a field or typedef.
    fn declarator(&mut self, kind: &Type) -> Parsed<Type> {
        let Some(token) = self.peek().filter(|token| token.text == "[") else {
            return Ok(kind.clone());
        };
        self.at += 1;
        let length = self.number()?;
        self.expect("]")?;
        if kind.arity.is_some() || self.peek().is_some_and(|token| token.text == "[") {
            return Err(fault(token, "ROS does not support arrays of arrays"));
        }
        Ok(Type {
            base: kind.base.clone(),
            arity: Some(format!("[{length}]")),
        })
    }

    fn constant(&mut self) -> Parsed<()> {
        self.at += 1;
        let kind = self.type_spec()?;
        let token = self.peek().ok_or_else(|| self.ended())?;
        let name = self.word()?;
        self.expect("=")?;
        let mut value = String::new();
        loop {
            let part = self.next()?;
            match (part.kind, part.text) {
                (_, ";") => break,
                (TokenKind::Quoted, quoted) => {
                    let inner = quoted.get(1..quoted.len().saturating_sub(1));
                    value.push_str(inner.unwrap_or_default());
                }
                (_, "TRUE") => value.push_str("true"),
                (_, "FALSE") => value.push_str("false"),
                (_, text) => value.push_str(text),
            }
        }
        let line = DefinitionLine {
            number: token.line,
            written: kind.written(),
            name: name.to_owned(),
            value: Some(value),
        };
        // The constants of a message are in a module named after the message.
        let of = self.scope.join("::");
        self.constants.entry(of).or_default().push(line);
        Ok(())
    }

    fn type_spec(&mut self) -> Parsed<Type> {
        let token = self.next()?;
        if token.kind != TokenKind::Word {
            return Err(fault(token, "a type expected"));
        }
        let alone = |base: &str| {
            Ok(Type {
                base: base.to_owned(),
                arity: None,
            })
        };
        match token.text {
            "boolean" => alone("bool"),
            "octet" => alone("byte"),
            "char" => alone("char"),
            "float" => alone("float32"),
            "double" => alone("float64"),
            "short" => alone("int16"),
            "long" if self.takes("long") => alone("int64"),
            "long" => alone("int32"),
            "unsigned" if self.takes("short") => alone("uint16"),
            "unsigned" if self.takes("long") => {
                if self.takes("long") {
                    alone("uint64")
                } else {
                    alone("uint32")
                }
            }
            word @ ("int8" | "uint8" | "int16" | "uint16" | "int32" | "uint32" | "int64"
            | "uint64") => alone(word),
            word @ ("string" | "wstring") => {
                if !self.takes("<") {
                    return alone(word);
                }
                let bound = self.number()?;
                self.expect(">")?;
                alone(&format!("{word}<={bound}"))
            }
            "sequence" => self.sequence(token),
            "unsigned" | "wchar" | "any" | "fixed" | "map" | "union" | "enum" => {
                Err(fault(token, "ROS does not support this type"))
            }
            _ => self.named(token),
        }
    }

    /// Parses the rest of a type after the word `sequence`.
    fn sequence(&mut self, token: Token<'t>) -> Parsed<Type> {
        self.expect("<")?;
        // A sequence in another sequence is refused here, so the recursion ends at the first `<<`
        // of the text.
        if self.peek().is_some_and(|next| next.text == "sequence") {
            return Err(fault(token, "ROS does not support arrays of arrays"));
        }
        let of = self.type_spec()?;
        if of.arity.is_some() {
            return Err(fault(token, "ROS does not support arrays of arrays"));
        }
        let bound = if self.takes(",") {
            format!("<={}", self.number()?)
        } else {
            String::new()
        };
        self.expect(">")?;
        Ok(Type {
            base: of.base,
            arity: Some(format!("[{bound}]")),
        })
    }

    /// Parses the name of a typedef, or of a message as `package::msg::Name` or `Name` of the same
    /// module.
    fn named(&mut self, first: Token<'t>) -> Parsed<Type> {
        let mut parts = vec![first.text];
        while self.takes("::") {
            parts.push(self.word()?);
        }
        let written = parts.join("::");
        for around in (0..=self.scope.len()).rev() {
            let scope = self.scope.get(..around).unwrap_or_default();
            let path: Vec<&str> = scope.iter().chain(&parts).copied().collect();
            if let Some(found) = self.typedefs.get(&path.join("::")) {
                return Ok(found.clone());
            }
        }
        let base = match (parts.as_slice(), self.scope.as_slice()) {
            ([package, "msg", name], _) => format!("{package}/{name}"),
            ([name], [package, "msg"]) => format!("{package}/{name}"),
            _ => {
                return Err(Fault {
                    line: first.line,
                    reason: "expected a type: an IDL type, an earlier typedef, or `package::msg::Name`",
                    text: written,
                });
            }
        };
        Ok(Type { base, arity: None })
    }

    /// Skips `@name` and the parentheses after it.
    fn annotation(&mut self) -> Parsed<()> {
        self.at += 1;
        self.word()?;
        if !self.takes("(") {
            return Ok(());
        }
        let mut open = 1_usize;
        while open > 0 {
            match self.next()?.text {
                "(" => open += 1,
                ")" => open -= 1,
                _ => {}
            }
        }
        Ok(())
    }

    fn path(&self, name: &str) -> String {
        let mut path = self.scope.join("::");
        if !path.is_empty() {
            path.push_str("::");
        }
        path.push_str(name);
        path
    }

    fn peek(&self) -> Option<Token<'t>> {
        self.tokens.get(self.at).copied()
    }

    fn next(&mut self) -> Parsed<Token<'t>> {
        let token = self.peek().ok_or_else(|| self.ended())?;
        self.at += 1;
        Ok(token)
    }

    fn takes(&mut self, text: &str) -> bool {
        let taken = self.peek().is_some_and(|token| token.text == text);
        self.at += usize::from(taken);
        taken
    }

    fn expect(&mut self, text: &'static str) -> Parsed<()> {
        let token = self.next()?;
        if token.text == text {
            return Ok(());
        }
        let reason = match text {
            ";" => "`;` expected",
            "{" => "`{` expected",
            "<" => "`<` expected",
            ">" => "`>` expected",
            "]" => "`]` expected",
            _ => "`=` expected",
        };
        Err(fault(token, reason))
    }

    fn word(&mut self) -> Parsed<&'t str> {
        let token = self.next()?;
        match token.kind {
            TokenKind::Word => Ok(token.text),
            TokenKind::Number | TokenKind::Quoted | TokenKind::Mark => {
                Err(fault(token, "a name expected"))
            }
        }
    }

    fn number(&mut self) -> Parsed<&'t str> {
        let token = self.next()?;
        match token.kind {
            TokenKind::Number => Ok(token.text),
            TokenKind::Word | TokenKind::Quoted | TokenKind::Mark => {
                Err(fault(token, "a number expected"))
            }
        }
    }

    fn ended(&self) -> Fault {
        Fault {
            line: self.tokens.last().map_or(1, |token| token.line),
            reason: "the text ends too early",
            text: String::new(),
        }
    }
}

fn fault(token: Token<'_>, reason: &'static str) -> Fault {
    Fault {
        line: token.line,
        reason,
        text: token.text.to_owned(),
    }
}

/// Returns words, numbers, quoted texts and marks, without comments and preprocessor lines.
fn tokens(text: &str) -> Parsed<Vec<Token<'_>>> {
    let mut found = Vec::new();
    let mut rest = text;
    let mut line = 1;
    while let Some(first) = rest.chars().next() {
        let length = length(rest, first).ok_or_else(|| Fault {
            line,
            reason: "a quote or comment is not closed",
            text: rest.lines().next().unwrap_or_default().to_owned(),
        })?;
        let (taken, behind) = rest.split_at_checked(length.max(1)).unwrap_or((rest, ""));
        let kind = match first {
            _ if first.is_whitespace() || first == '#' => None,
            '/' if taken.len() > 1 => None,
            '"' | '\'' => Some(TokenKind::Quoted),
            _ if first.is_ascii_alphabetic() || first == '_' => Some(TokenKind::Word),
            _ if first.is_ascii_digit() || first == '.' => Some(TokenKind::Number),
            _ => Some(TokenKind::Mark),
        };
        if let Some(TokenKind::Word | TokenKind::Number) = kind
            && taken.len() > LONGEST
        {
            return Err(Fault {
                line,
                reason: "expected a name or number of at most 255 bytes",
                text: taken.to_owned(),
            });
        }
        if let Some(kind) = kind {
            found.push(Token {
                kind,
                text: taken,
                line,
            });
        }
        line += taken.matches('\n').count();
        rest = behind;
    }
    Ok(found)
}

/// Returns the length of the first token in bytes, or `None` if the token does not end.
fn length(rest: &str, first: char) -> Option<usize> {
    let while_of = |keep: fn(char) -> bool| rest.find(|c: char| !keep(c)).or(Some(rest.len()));
    match first {
        '#' => while_of(|c| c != '\n'),
        _ if first.is_whitespace() => while_of(char::is_whitespace),
        '/' if rest.starts_with("//") => while_of(|c| c != '\n'),
        '/' if rest.starts_with("/*") => rest.get(2..)?.find("*/").map(|at| at + 4),
        '"' | '\'' => {
            let mut escaped = false;
            for (at, c) in rest.char_indices().skip(1) {
                match c {
                    '\n' => return None,
                    _ if escaped => escaped = false,
                    '\\' => escaped = true,
                    _ if c == first => return Some(at + 1),
                    _ => {}
                }
            }
            None
        }
        ':' if rest.starts_with("::") => Some(2),
        _ if first.is_ascii_alphabetic() || first == '_' => {
            while_of(|c| c.is_ascii_alphanumeric() || c == '_')
        }
        // The sign of an exponent is a mark of its own; it is joined with the rest of a constant.
        _ if first.is_ascii_digit() || first == '.' => {
            while_of(|c| c.is_ascii_alphanumeric() || c == '.')
        }
        _ => Some(first.len_utf8()),
    }
}

/// Limit of nested modules; ROS uses two levels, and three for constants.
const DEEPEST: usize = 16;
/// Limit of a name or number in bytes; file systems do not allow longer names for type files.
const LONGEST: usize = 255;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::TypeRegistry;

    const LEG: &str = r#"
// generated from rosidl_adapter/resource/msg.idl.em
#include "std_msgs/msg/Header.idl"
#include "geometry_msgs/msg/Point.idl"

module robot_msgs {
  module msg {
    typedef double double__3[3];
    typedef geometry_msgs::msg::Point geometry_msgs__msg__Point;
    typedef geometry_msgs__msg__Point geometry_msgs__msg__Point__4[4];
    module Leg_Constants {
      @verbatim (language="comment", text=
        "Which ( leg" "\n" "it is")
      const uint8 LEFT = 1;
      const string SIDE = "l # \"x\"";
      const float EPSILON = -1.5e-3;
      const boolean IS = TRUE;
    };
    @verbatim (language="comment", text="A leg; of { many }")
    struct Leg {
      std_msgs::msg::Header header; /* of the
        base */
      @key
      @default (value=5)
      @unit (value="rad")
      double__3 angles;
      geometry_msgs__msg__Point__4 corners;
      sequence<Foot> feet;
      sequence<string<8>, 3> names;
      wstring<4> short_name;
      octet raw; int8 a, b[2]; unsigned long long count;
    };
    struct Nothing { uint8 structure_needs_at_least_one_member; };
  };
};
"#;

    const LEG_MSG: &str = "std_msgs/Header header\nfloat64[3] angles\ngeometry_msgs/Point[4] corners\nFoot[] feet\n\
        string<=8[<=3] names\nwstring<=4 short_name\nbyte raw\nint8 a\nint8[2] b\nuint64 count\n";

    fn registry() -> TypeRegistry {
        let mut registry = TypeRegistry::bundle(Dialect::Ros2);
        registry
            .add(&"robot_msgs/Foot".parse().unwrap(), "bool down")
            .unwrap();
        registry
    }

    #[test]
    fn an_idl_text_makes_the_definition_its_msg_text_makes() {
        let name: TypeName = "robot_msgs/Leg".parse().unwrap();
        let (mut idl, mut msg) = (registry(), registry());
        idl.add_idl(TextKind::Message, &name, LEG).unwrap();
        msg.add(&name, LEG_MSG).unwrap();
        assert_eq!(idl.type_hash(&name), msg.type_hash(&name));
        let (idl, msg) = (idl.get(&name).unwrap(), msg.get(&name).unwrap());
        assert_eq!(idl.leaves(), msg.leaves());
        let constants: Vec<_> = idl
            .constants()
            .iter()
            .map(|constant| (constant.name.as_str(), constant.value.as_str()))
            .collect();
        assert_eq!(
            constants,
            [
                ("LEFT", "1"),
                ("SIDE", r#"l # \"x\""#),
                ("EPSILON", "-1.5e-3"),
                ("IS", "true")
            ]
        );
    }

    #[test]
    fn a_struct_of_nothing_is_an_empty_message() {
        let name: TypeName = "robot_msgs/Nothing".parse().unwrap();
        let mut registry = registry();
        registry.add_idl(TextKind::Message, &name, LEG).unwrap();
        assert!(registry.get(&name).unwrap().leaves().is_empty());
    }

    #[test]
    fn what_ros_does_not_know_is_told_with_its_line() {
        let name: TypeName = "p/T".parse().unwrap();
        for (member, reason) in [
            ("long double x;", "`;` expected"),
            ("wchar x;", "ROS does not support this type"),
            ("double x[2][3];", "ROS does not support arrays of arrays"),
            (
                "sequence<sequence<long>> x;",
                "ROS does not support arrays of arrays",
            ),
            ("double x", "`;` expected"),
            (
                "Other::X x;",
                "expected a type: an IDL type, an earlier typedef, or `package::msg::Name`",
            ),
            (
                "double x[99999999999999];",
                "expected a length of at most 4294967295",
            ),
            ("double x; double x;", "the field is defined twice"),
            ("\"x", "a quote or comment is not closed"),
            (
                format!("double {};", "x".repeat(256)).as_str(),
                "expected a name or number of at most 255 bytes",
            ),
            (
                format!("double x[{}];", "1".repeat(256)).as_str(),
                "expected a name or number of at most 255 bytes",
            ),
        ] {
            let text = format!("module p {{ module msg {{\nstruct T {{\n{member} }};\n}}; }};");
            let error = TypeRegistry::empty(Dialect::Ros2)
                .add_idl(TextKind::Message, &name, &text)
                .unwrap_err();
            let DefinitionError::Syntax {
                line, reason: told, ..
            } = error
            else {
                unreachable!("{error}");
            };
            assert_eq!((line, told), (3, reason), "{member}");
        }
        let missing = TypeRegistry::empty(Dialect::Ros2)
            .add_idl(TextKind::Message, &name, "module p { module msg { }; };")
            .unwrap_err();
        assert!(missing.to_string().contains("p::msg::T"), "{missing}");
    }

    #[test]
    fn services_and_actions_are_structs_side_by_side() {
        let name: TypeName = "p/Turn".parse().unwrap();
        let service = "module p { module srv { struct Turn_Request { double angle; }; struct Turn_Response { boolean ok; }; }; };";
        let mut idl = TypeRegistry::bundle(Dialect::Ros2);
        idl.add_idl(TextKind::Service, &name, service).unwrap();
        let mut srv = TypeRegistry::bundle(Dialect::Ros2);
        srv.add_service(&name, "float64 angle\n---\nbool ok")
            .unwrap();
        assert_eq!(
            idl.service_type_hashes(&name).unwrap(),
            srv.service_type_hashes(&name).unwrap()
        );
        let action = "module p { module action { struct Turn_Goal { double angle; }; struct Turn_Result { uint8 structure_needs_at_least_one_member; }; \
            struct Turn_Feedback { float left; }; }; };";
        idl.add_idl(TextKind::Action, &name, action).unwrap();
        let made = idl.action_messages(&name).unwrap();
        assert_eq!(made.feedback().leaves()[0].path, "left");
        assert_eq!(made.result_response().leaves().len(), 1);
    }
}
