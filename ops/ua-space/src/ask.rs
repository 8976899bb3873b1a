//! `ua-space ask`: queries the knowledge base of the plant.

use std::fs::File;
use std::io::{self, Read, Write as _};

use serde::Deserialize;
use serde_json::{Map, Value};
use uri_text::escaped;

use crate::arguments::AskArguments;
use crate::exit::CommandFailure;
use crate::http::{HttpResponse, HttpServer};
use crate::live::{TextTable, harmless, is_coloured};
use crate::survey::look;

/// Runs `ua-space ask`.
pub(crate) fn ask(arguments: &AskArguments) -> Result<(), CommandFailure> {
    let server = HttpServer::parse(&arguments.mes.url)?;
    let query = arguments.sparql.as_deref().map(read).transpose()?;
    look(async {
        let answer = match (query, &arguments.question) {
            (Some(query), _) => server.query("/sparql", query).await?,

            (None, None) => server.get("/ask").await?,
            (None, Some(question)) => {
                let path = path(&server, question, &arguments.arguments).await?;
                server.get(&path).await?
            }
        };
        if answer.status != 200 {
            return Err(refusal(&answer));
        }
        show(&answer, arguments)
    })
}

fn read(file: &str) -> Result<String, CommandFailure> {
    let mut text = String::new();
    let read = match file {
        "-" => io::stdin()
            .lock()
            .take(MOST_QUERY)
            .read_to_string(&mut text),
        path => File::open(path).and_then(|file| file.take(MOST_QUERY).read_to_string(&mut text)),
    };
    read.map_err(|error| CommandFailure::reading(crate::input::name(file), &error))?;
    Ok(text)
}

/// The list of available questions.
#[derive(Debug, Deserialize)]
struct Questions {
    questions: Vec<Question>,
}

#[derive(Debug, Deserialize)]
struct Question {
    name: String,
    #[serde(default)]
    about: String,
    #[serde(default)]
    parameters: Vec<String>,
}

/// Rows of named values.
#[derive(Debug, Deserialize)]
struct Rows {
    columns: Vec<String>,
    rows: Vec<Map<String, Value>>,
}

/// The JSON results format of SPARQL 1.1.
#[derive(Debug, Deserialize)]
struct Results {
    #[serde(default)]
    head: Head,
    #[serde(default)]
    results: Option<Bindings>,
    #[serde(default)]
    boolean: Option<bool>,
}

#[derive(Debug, Default, Deserialize)]
struct Head {
    #[serde(default)]
    vars: Vec<String>,
}

#[derive(Debug, Deserialize)]
struct Bindings {
    bindings: Vec<Map<String, Value>>,
}

/// Returns the request path of a question with its parameters. Values without a name take the
/// parameter names of the question in order.
async fn path(
    server: &HttpServer,
    question: &str,
    words: &[String],
) -> Result<String, CommandFailure> {
    let is_named = |word: &String| {
        let name = word.split_once('=').map(|(name, _)| name);
        let plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_');
        name.is_some_and(|name| !name.is_empty() && name.chars().all(plain))
    };
    let mut places = Vec::new();
    if !words.iter().all(is_named) {
        let all = questions(server).await?;
        let known = all.questions.into_iter().find(|it| it.name == question);
        let known = known
            .ok_or_else(|| CommandFailure::Usage(format!("there is no question {question}")))?;
        places = known.parameters;
    }
    let mut places = places.into_iter();
    let mut pairs = Vec::new();
    for word in words {
        let pair = match word.split_once('=') {
            Some((name, value)) if is_named(word) => format!("{name}={}", escaped(value)),
            Some(_) | None => {
                let name = places.next();
                let name = name.ok_or_else(|| {
                    CommandFailure::Usage(format!(
                        "{question} does not take so many values: {word}"
                    ))
                })?;
                format!("{}={}", escaped(&name), escaped(word))
            }
        };
        pairs.push(pair);
    }
    let query = if pairs.is_empty() {
        String::new()
    } else {
        format!("?{}", pairs.join("&"))
    };
    Ok(format!("/ask/{}{query}", escaped(question)))
}

async fn questions(server: &HttpServer) -> Result<Questions, CommandFailure> {
    let answer = server.get("/ask").await?;
    parsed(&answer.body)
}

pub(crate) fn parsed<'a, T: Deserialize<'a>>(body: &'a str) -> Result<T, CommandFailure> {
    serde_json::from_str(body)
        .map_err(|error| CommandFailure::Data(format!("the answer was not understood: {error}")))
}

/// Returns the reason of a response with an error status.
pub(crate) fn refusal(answer: &HttpResponse) -> CommandFailure {
    #[derive(Deserialize)]
    struct RefusedQuestion {
        error: String,
        message: String,
    }
    let told: Option<RefusedQuestion> = serde_json::from_str(&answer.body).ok();
    let why = match &told {
        Some(told) => format!("{}: {}", harmless(&told.error), harmless(&told.message)),
        None => format!("HTTP status {}", answer.status),
    };
    match answer.status {
        404 => CommandFailure::Usage(why),
        400 | 406 | 413 | 415 => CommandFailure::Data(why),
        _ => CommandFailure::Unavailable(why),
    }
}

fn show(answer: &HttpResponse, arguments: &AskArguments) -> Result<(), CommandFailure> {
    let mut out = io::stdout().lock();
    let is_json = answer.content_type.contains("json");
    if arguments.json || !is_json {
        let text = answer.body.trim_end();
        if is_json {
            writeln!(out, "{}", mappings::harmless_json(text))?
        } else {
            for line in text.lines() {
                writeln!(out, "{}", harmless(line))?;
            }
        }
        return Ok(());
    }
    let table = match (&arguments.sparql, &arguments.question) {
        (Some(_), _) => {
            let results: Results = parsed(&answer.body)?;
            if let Some(yes) = results.boolean {
                writeln!(out, "{}", if yes { "yes" } else { "no" })?;
                return Ok(());
            }
            let found = results.results.map(|found| found.bindings);
            of_rows(&results.head.vars, &found.unwrap_or_default())
        }
        (None, Some(_)) => {
            let rows: Rows = parsed(&answer.body)?;
            of_rows(&rows.columns, &rows.rows)
        }
        (None, None) => {
            let all: Questions = parsed(&answer.body)?;
            let mut table = TextTable::new(["QUESTION", "TAKES", "ABOUT"].map(str::to_owned));
            for question in all.questions {
                table.row([
                    question.name,
                    question.parameters.join(", "),
                    question.about,
                ]);
            }
            table
        }
    };
    table.write(&mut out, is_coloured())?;
    Ok(())
}

fn of_rows(columns: &[String], rows: &[Map<String, Value>]) -> TextTable {
    let mut table = TextTable::new(columns.iter().map(|name| name.to_uppercase()));
    for row in rows {
        table.row(
            columns
                .iter()
                .map(|name| row.get(name).map_or_else(dash, cell)),
        );
    }
    table
}

fn dash() -> String {
    "-".to_owned()
}

/// Formats a value for a cell; a term of the SPARQL results format is shown by its `value`.
fn cell(value: &Value) -> String {
    match value {
        Value::Null => dash(),
        Value::String(text) => text.clone(),
        Value::Array(all) if all.is_empty() => dash(),
        Value::Array(all) => all.iter().map(cell).collect::<Vec<_>>().join(", "),
        Value::Object(term) => term.get("value").map_or_else(|| value.to_string(), cell),
        Value::Bool(_) | Value::Number(_) => value.to_string(),
    }
}

/// Maximum length of a query, in bytes.
const MOST_QUERY: u64 = 1 << 20;
