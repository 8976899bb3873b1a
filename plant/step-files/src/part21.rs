//! The text form of STEP files, ISO 10303-21: records of the DATA sections.

use std::collections::HashMap;

use crate::strings::decoded;

/// A parameter of a record.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Parameter {
    /// `$` or `*`.
    Omitted,
    Integer(i64),
    Real(f64),
    Text(String),
    /// `.NAME.`
    Enumeration(String),
    /// `#12`
    Reference(u64),
    List(Vec<Self>),
    /// `NAME(..)`, a value with its type.
    Typed(String, Vec<Self>),
}

/// An entity of a record with its parameters.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct EntityPart {
    /// In upper case.
    pub(crate) name: String,
    pub(crate) parameters: Vec<Parameter>,
}

/// An instance: a single entity, or the parts of a complex one.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct EntityRecord {
    /// The line of its number, from 1.
    pub(crate) line: usize,
    pub(crate) parts: Vec<EntityPart>,
}

/// The records of a file.
#[derive(Debug, Default)]
pub(crate) struct ExchangeFile {
    /// The names of the schemas, in upper case.
    pub(crate) schemas: Vec<String>,
    pub(crate) records: HashMap<u64, EntityRecord>,
}

/// Reason for refusing a file.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum StepFault {
    /// The text is not in the form of ISO 10303-21.
    #[error("line {line}: found {found}, expected {expected}; export the file again")]
    Syntax {
        /// The line, from 1.
        line: usize,
        /// The text at the position.
        found: String,
        /// The expected text.
        expected: &'static str,
    },
    /// Two records have the same number.
    #[error("line {line}: the number #{id} is used twice; export the file again")]
    Twice {
        /// The line of the second record, from 1.
        line: usize,
        /// The number.
        id: u64,
    },
    /// A number is not finite, or too large for its type.
    #[error("line {line}: the number `{text}` is too large")]
    Number {
        /// The line, from 1.
        line: usize,
        /// The number.
        text: String,
    },
    /// A limit is exceeded.
    #[error("line {line}: the file has more than {most} {what}; split it")]
    TooMany {
        /// The line, from 1.
        line: usize,
        /// The limit.
        most: usize,
        /// The limited things.
        what: &'static str,
    },
    /// The schema is not one of products.
    #[error("the schema is `{found}`; export the file as AP203, AP214 or AP242")]
    Schema {
        /// The schemas of the file.
        found: String,
    },
    /// The time of the reading is over.
    #[error("line {line}: the time to read the file was over before its end; split it")]
    Late {
        /// The line that was read last, from 1.
        line: usize,
    },
    /// No record is a product.
    #[error("the file has no product; export it as AP203, AP214 or AP242")]
    NoProduct,
}

impl ExchangeFile {
    /// Reads a file, until `is_over` returns true.
    ///
    /// # Errors
    /// The first fault of the text.
    pub(crate) fn read(bytes: &[u8], is_over: &dyn Fn() -> bool) -> Result<Self, StepFault> {
        if bytes.len() > LARGEST {
            let (line, most) = (1, LARGEST);
            let what = "bytes";
            return Err(StepFault::TooMany { line, most, what });
        }
        let mut reader = Reader {
            bytes,
            at: 0,
            line: 1,
            parameters: 0,
            is_over,
        };
        reader.file()
    }
}

struct Reader<'b> {
    bytes: &'b [u8],
    at: usize,
    line: usize,
    /// The number of parameters so far.
    parameters: usize,
    /// Returns whether the time of the reading is over.
    is_over: &'b dyn Fn() -> bool,
}

impl Reader<'_> {
    fn file(&mut self) -> Result<ExchangeFile, StepFault> {
        let mut file = ExchangeFile::default();
        self.expect("ISO-10303-21")?;
        self.expect(";")?;
        self.expect("HEADER")?;
        self.expect(";")?;
        while !self.takes("ENDSEC") {
            let part = self.part(0)?;
            self.expect(";")?;
            if part.name == "FILE_SCHEMA" {
                file.schemas = schemas(&part);
            }
        }
        self.expect(";")?;
        // Sections of the third edition before the data name records; they add no geometry.
        while !self.takes("END-ISO-10303-21") {
            if self.takes("DATA") {
                self.data(&mut file)?;
            } else if self.takes("ANCHOR") || self.takes("REFERENCE") || self.takes("SIGNATURE") {
                self.skip_section()?;
            } else {
                return Err(self.wrong("DATA or END-ISO-10303-21"));
            }
        }
        self.expect(";")?;
        Ok(file)
    }

    fn data(&mut self, file: &mut ExchangeFile) -> Result<(), StepFault> {
        if self.peek() == Some(b'(') {
            self.list(0)?;
        }
        self.expect(";")?;
        while !self.takes("ENDSEC") {
            let line = self.line_here();
            let id = self.instance()?;
            self.expect("=")?;
            let mut parts = Vec::new();
            if self.takes("(") {
                while !self.takes(")") {
                    if parts.len() >= MOST_PARTS {
                        return Err(self.too_many(MOST_PARTS, "parts of an instance"));
                    }
                    parts.push(self.part(0)?);
                }
            } else {
                parts.push(self.part(0)?);
            }
            self.expect(";")?;
            let record = EntityRecord { line, parts };
            if file.records.insert(id, record).is_some() {
                return Err(StepFault::Twice { line, id });
            }
            if file.records.len() % BETWEEN_LOOKS == 1 && (self.is_over)() {
                return Err(StepFault::Late { line });
            }
            if file.records.len() > MOST_RECORDS {
                return Err(self.too_many(MOST_RECORDS, "records"));
            }
        }
        self.expect(";")
    }

    /// Skips a section that is not read, up to the end of its `ENDSEC`.
    fn skip_section(&mut self) -> Result<(), StepFault> {
        while !self.takes("ENDSEC") {
            match self.peek() {
                None => return Err(self.wrong("ENDSEC")),
                Some(b'\'') => drop(self.text()?),
                Some(_) => self.at += 1,
            }
        }
        self.expect(";")
    }

    fn part(&mut self, depth: usize) -> Result<EntityPart, StepFault> {
        let name = self
            .word()
            .ok_or_else(|| self.wrong("the name of an entity"))?;
        let parameters = self.list(depth)?;
        Ok(EntityPart { name, parameters })
    }

    /// Reads a list in parentheses.
    fn list(&mut self, depth: usize) -> Result<Vec<Parameter>, StepFault> {
        if depth > DEEPEST {
            return Err(self.too_many(DEEPEST, "lists within each other"));
        }
        self.expect("(")?;
        let mut all = Vec::new();
        if self.takes(")") {
            return Ok(all);
        }
        loop {
            self.parameters += 1;
            if self.parameters > MOST_PARAMETERS {
                return Err(self.too_many(MOST_PARAMETERS, "parameters"));
            }
            all.push(self.parameter(depth)?);
            if self.takes(")") {
                return Ok(all);
            }
            self.expect(",")?;
        }
    }

    fn parameter(&mut self, depth: usize) -> Result<Parameter, StepFault> {
        match self.peek() {
            Some(b'$' | b'*') => {
                self.at += 1;
                Ok(Parameter::Omitted)
            }
            Some(b'\'') => self.text().map(Parameter::Text),
            Some(b'"') => self.binary(),
            Some(b'#') => self.instance().map(Parameter::Reference),
            Some(b'.') => {
                self.at += 1;
                let name = self.word().ok_or_else(|| self.wrong("an enumeration"))?;
                self.expect(".")?;
                Ok(Parameter::Enumeration(name))
            }
            Some(b'(') => self.list(depth + 1).map(Parameter::List),
            Some(b'+' | b'-' | b'0'..=b'9') => self.number(),
            _ => {
                let name = self.word().ok_or_else(|| self.wrong("a parameter"))?;
                Ok(Parameter::Typed(name, self.list(depth + 1)?))
            }
        }
    }

    fn number(&mut self) -> Result<Parameter, StepFault> {
        let from = self.at;
        self.at += 1;
        while let Some(byte) = self.bytes.get(self.at) {
            let is_sign = matches!(byte, b'+' | b'-')
                && matches!(self.bytes.get(self.at - 1), Some(b'E' | b'e'));
            if !(byte.is_ascii_digit() || matches!(byte, b'.' | b'E' | b'e') || is_sign) {
                break;
            }
            self.at += 1;
        }
        let text = self.bytes.get(from..self.at).unwrap_or_default();
        let text = std::str::from_utf8(text).unwrap_or_default();
        let (line, shown) = (self.line, || text.chars().take(SHOWN).collect());
        let text = text.strip_prefix('+').unwrap_or(text);
        if !text.contains('.') && !text.contains(['e', 'E']) {
            let read = text.parse().map(Parameter::Integer);
            return read.map_err(|_| StepFault::Number {
                line,
                text: shown(),
            });
        }
        match text.parse::<f64>() {
            Ok(number) if number.is_finite() => Ok(Parameter::Real(number)),
            Ok(_) => Err(StepFault::Number {
                line,
                text: shown(),
            }),
            Err(_) => Err(StepFault::Syntax {
                line,
                found: format!("`{}`", shown()),
                expected: "a number",
            }),
        }
    }

    fn instance(&mut self) -> Result<u64, StepFault> {
        self.expect("#")?;
        let from = self.at;
        while self.bytes.get(self.at).is_some_and(u8::is_ascii_digit) {
            self.at += 1;
        }
        let digits = self.bytes.get(from..self.at).unwrap_or_default();
        let digits = std::str::from_utf8(digits).unwrap_or_default();
        digits
            .parse()
            .map_err(|_| self.wrong("the number of a record"))
    }

    /// Reads a string in quotes. A quote in it is doubled.
    fn text(&mut self) -> Result<String, StepFault> {
        self.expect("'")?;
        let mut raw = Vec::new();
        loop {
            match self.bytes.get(self.at) {
                None => return Err(self.wrong("the end of a string")),
                Some(b'\'') if self.bytes.get(self.at + 1) == Some(&b'\'') => {
                    raw.push(b'\'');
                    self.at += 2;
                }
                Some(b'\'') => {
                    self.at += 1;
                    return Ok(decoded(&raw));
                }
                Some(byte) => {
                    self.line += usize::from(*byte == b'\n');
                    // Line ends within a string are no part of it.
                    if !matches!(byte, b'\n' | b'\r') {
                        raw.push(*byte);
                    }
                    self.at += 1;
                }
            }
        }
    }

    /// Skips a binary value, which no geometry has.
    fn binary(&mut self) -> Result<Parameter, StepFault> {
        self.expect("\"")?;
        while self.bytes.get(self.at).is_some_and(u8::is_ascii_hexdigit) {
            self.at += 1;
        }
        self.expect("\"")?;
        Ok(Parameter::Omitted)
    }

    /// Reads the name of an entity, a type or an enumeration.
    fn word(&mut self) -> Option<String> {
        self.space();
        let rest = self.bytes.get(self.at..)?;
        let is_part = |byte: &u8| byte.is_ascii_alphanumeric() || matches!(byte, b'_' | b'!');
        let length = rest.iter().take_while(|byte| is_part(byte)).count();
        let word = rest.get(..length).filter(|word| !word.is_empty())?;
        self.at += length;
        Some(String::from_utf8_lossy(word).to_ascii_uppercase())
    }

    fn peek(&mut self) -> Option<u8> {
        self.space();
        self.bytes.get(self.at).copied()
    }

    fn line_here(&mut self) -> usize {
        self.space();
        self.line
    }

    /// Skips white space and comments.
    fn space(&mut self) {
        while let Some(byte) = self.bytes.get(self.at) {
            if byte.is_ascii_whitespace() {
                self.line += usize::from(*byte == b'\n');
                self.at += 1;
            } else if self.bytes.get(self.at..self.at + 2) == Some(b"/*") {
                let rest = self.bytes.get(self.at + 2..).unwrap_or_default();
                let Some(length) = rest.windows(2).position(|pair| pair == b"*/") else {
                    // The rest is a comment without an end: the file is truncated.
                    self.at = self.bytes.len();
                    return;
                };
                let comment = rest.get(..length).unwrap_or_default();
                self.line += comment.iter().filter(|byte| **byte == b'\n').count();
                self.at += length + 4;
            } else {
                return;
            }
        }
    }

    /// Skips a text if it is next.
    fn takes(&mut self, text: &str) -> bool {
        self.space();
        let rest = self.bytes.get(self.at..).unwrap_or_default();
        let is_next = rest
            .get(..text.len())
            .is_some_and(|next| next.eq_ignore_ascii_case(text.as_bytes()));
        let is_word = text
            .as_bytes()
            .last()
            .is_some_and(u8::is_ascii_alphanumeric);
        let goes_on = rest
            .get(text.len())
            .is_some_and(|byte| byte.is_ascii_alphanumeric() || *byte == b'_');
        let takes = is_next && !(is_word && goes_on);
        if takes {
            self.at += text.len();
        }
        takes
    }

    fn expect(&mut self, text: &'static str) -> Result<(), StepFault> {
        if self.takes(text) {
            Ok(())
        } else {
            Err(self.wrong(text))
        }
    }

    fn wrong(&self, expected: &'static str) -> StepFault {
        let rest = self.bytes.get(self.at..).unwrap_or_default();
        let next = rest.get(..rest.len().min(SHOWN)).unwrap_or_default();
        let next = String::from_utf8_lossy(next);
        let shown = next.lines().next().unwrap_or_default();
        let found = if rest.is_empty() {
            "the end of the file".to_owned()
        } else {
            format!("`{}`", shown.escape_debug())
        };
        let line = self.line;
        StepFault::Syntax {
            line,
            found,
            expected,
        }
    }

    fn too_many(&self, most: usize, what: &'static str) -> StepFault {
        let line = self.line;
        StepFault::TooMany { line, most, what }
    }
}

/// Returns the names of FILE_SCHEMA without their object identifiers.
fn schemas(part: &EntityPart) -> Vec<String> {
    let Some(Parameter::List(names)) = part.parameters.first() else {
        return Vec::new();
    };
    let names = names.iter().filter_map(|name| {
        let Parameter::Text(name) = name else {
            return None;
        };
        name.split_whitespace().next()
    });
    names.map(str::to_ascii_uppercase).collect()
}

/// Maximum size of a file in bytes.
const LARGEST: usize = 64 << 20;
/// Maximum number of records.
const MOST_RECORDS: usize = 1_000_000;
/// Number of records between two checks of the time limit.
const BETWEEN_LOOKS: usize = 4096;
/// Maximum number of parameters of all records.
const MOST_PARAMETERS: usize = 3_000_000;
/// Maximum number of entities of a complex instance.
const MOST_PARTS: usize = 64;
/// Maximum depth of lists.
const DEEPEST: usize = 16;
/// Number of bytes of the text that a fault shows.
const SHOWN: usize = 24;

#[cfg(test)]
mod tests {
    use super::*;

    fn file(data: &str) -> String {
        format!(
            "ISO-10303-21;\nHEADER;\nFILE_SCHEMA(('AUTOMOTIVE_DESIGN {{ 1 0 }}'));\nENDSEC;\nDATA;\n{data}\nENDSEC;\nEND-ISO-10303-21;\n"
        )
    }

    #[test]
    fn records_have_all_kinds_of_parameters() {
        let text = file(
            "#1 = A($,*,-2,+1.5E-1,'it''s \\X2\\00E4\\X0\\', .T., #7, (1., (2.)), LENGTH(3.)) ; /* a\n; comment */\n#2=(B(1)C_D());",
        );
        let read = ExchangeFile::read(text.as_bytes(), &|| false).unwrap();
        assert_eq!(read.schemas, ["AUTOMOTIVE_DESIGN"]);
        let expected = vec![
            Parameter::Omitted,
            Parameter::Omitted,
            Parameter::Integer(-2),
            Parameter::Real(0.15),
            Parameter::Text("it's \u{e4}".to_owned()),
            Parameter::Enumeration("T".to_owned()),
            Parameter::Reference(7),
            Parameter::List(vec![
                Parameter::Real(1.0),
                Parameter::List(vec![Parameter::Real(2.0)]),
            ]),
            Parameter::Typed("LENGTH".to_owned(), vec![Parameter::Real(3.0)]),
        ];
        assert_eq!(read.records[&1].parts[0].parameters, expected);
        let names: Vec<&str> = read.records[&2]
            .parts
            .iter()
            .map(|part| &*part.name)
            .collect();
        assert_eq!((names, read.records[&2].line), (vec!["B", "C_D"], 8));
    }

    #[test]
    fn a_fault_has_the_line_and_the_text() {
        let deep = format!("#1=A({}{});", "(".repeat(40), ")".repeat(40));
        for (data, expected) in [
            (
                "#1=A(1.0E999);",
                "line 6: the number `1.0E999` is too large",
            ),
            ("#1=A();\n#1=B();", "line 7: the number #1 is used twice"),
            ("#1=A(1;", "line 6: found `;`, expected ,"),
            ("#1=A('x", "expected the end of a string"),
            ("#1=A(1.2.3);", "line 6: found `1.2.3`, expected a number"),
            (
                "#1=A(#99999999999999999999);",
                "expected the number of a record",
            ),
            (&deep, "more than 16 lists within each other"),
        ] {
            let fault = ExchangeFile::read(file(data).as_bytes(), &|| false).unwrap_err();
            assert!(fault.to_string().contains(expected), "{data}: {fault}");
        }
        let whole = file("#1=A(1);");
        for length in 0..whole.trim_end().len() {
            let cut = ExchangeFile::read(&whole.as_bytes()[..length], &|| false);
            assert!(cut.is_err(), "{length}");
        }
    }
}
