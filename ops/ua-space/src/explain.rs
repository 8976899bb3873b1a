//! `ua-space explain` and `ua-space schema`: explains the code of a finding, and prints the schema
//! of mappings.

use std::io::{self, BufWriter, Write as _};

use mappings::Code;

use crate::arguments::Explain;
use crate::exit::CommandFailure;

pub(crate) fn explain(arguments: &Explain) -> Result<(), CommandFailure> {
    let mut out = BufWriter::new(io::stdout().lock());
    match arguments.code {
        None => {
            for code in Code::ALL {
                writeln!(out, "{code}  {}", first_sentence(code.explanation()))?;
            }
        }
        Some(code) => {
            let (document, findings) = code.example();
            writeln!(
                out,
                "{code}: {}\n\nFor example, this mapping:\n",
                code.explanation()
            )?;
            for (number, line) in document.lines().enumerate() {
                writeln!(out, "{:3} | {line}", number + 1)?;
            }
            writeln!(out, "\nhas these findings:\n")?;
            out.write_all(findings.as_bytes())?;
        }
    }
    Ok(out.flush()?)
}

pub(crate) fn schema() -> Result<(), CommandFailure> {
    let mut out = io::stdout().lock();
    out.write_all(mappings::schema().as_bytes())?;
    Ok(out.flush()?)
}

fn first_sentence(text: &str) -> &str {
    text.split_once(". ").map_or(text, |(first, _)| first)
}
