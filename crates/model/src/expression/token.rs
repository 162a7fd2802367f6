//! Tokens: text → tokens, each with its place.

use super::parse::ParseError;

#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Token {
    /// A name or a keyword.
    Word(String),
    /// `$name`
    Variable(String),
    /// A whole number.
    Int(i64),
    /// A number with a point or an exponent.
    Float(f64),
    /// Quoted text.
    Text(String),
    /// An operator or a bracket.
    Symbol(&'static str),
    /// The end of the text.
    End,
}

/// Symbols; longer ones first.
const SYMBOLS: [&str; 22] =
    ["==", "!=", "<=", ">=", "=", "<", ">", "+", "-", "*", "/", "(", ")", "[", "]", "{", "}", ",", ".", ":", "?", "|"];

/// Operators of other languages and their replacements; longer ones first.
const FOREIGN: [(&str, &str); 10] = [
    ("===", "="),
    ("!==", "!="),
    ("&&", "and"),
    ("||", "or"),
    ("<>", "!="),
    ("**", "x * x"),
    ("//", "floor(a / b)"),
    ("&", "and"),
    ("!", "not"),
    ("%", "n - m * floor(n / m)"),
];
/// Units that people write after a number.
const UNITS: [&str; 11] = ["s", "ms", "min", "h", "m", "cm", "mm", "rad", "deg", "kg", "g"];

impl Token {
    /// The token for a message.
    pub(crate) fn described(&self) -> String {
        match self {
            Token::Word(word) => format!("`{word}`"),
            Token::Variable(name) => format!("`${name}`"),
            Token::Int(i) => format!("`{i}`"),
            Token::Float(x) => format!("`{x}`"),
            Token::Text(_) => "a text".to_owned(),
            Token::Symbol(symbol) => format!("`{symbol}`"),
            Token::End => "the end".to_owned(),
        }
    }
}

/// The tokens of a text with the offset of each in characters; the last is [`Token::End`].
///
/// # Errors
/// [`ParseError`] at the first character that begins no token.
pub(crate) fn tokens(text: &str) -> Result<Vec<(usize, Token)>, ParseError> {
    let characters: Vec<char> = text.chars().collect();
    let mut tokens = Vec::new();
    let mut at = 0;
    while at < characters.len() {
        let c = characters[at];
        if c.is_whitespace() {
            at += 1;
            continue;
        }
        let start = at;
        let token = if c.is_ascii_alphabetic() || c == '_' {
            Token::Word(word(&characters, &mut at))
        } else if c.is_ascii_digit() {
            number(&characters, &mut at)?
        } else if c == '$' {
            at += 1;
            let name = word(&characters, &mut at);
            if name.is_empty() {
                return Err(ParseError::syntax(start, "expected a variable's name after `$`"));
            }
            Token::Variable(name)
        } else if c == '"' || c == '\'' {
            quoted(&characters, &mut at)?
        } else {
            let stands_here = |s: &str| s.chars().enumerate().all(|(i, c)| characters.get(at + i) == Some(&c));
            let symbol = SYMBOLS.iter().find(|s| stands_here(s));
            let foreign = FOREIGN.iter().find(|(foreign, _)| stands_here(foreign));
            if let Some((foreign, word)) = foreign
                && symbol.is_none_or(|symbol| foreign.len() > symbol.len())
            {
                let error = ParseError::syntax(start, format!("`{foreign}` is no operator here"));
                return Err(error.with_help(format!("write `{word}`")));
            }
            let Some(symbol) = symbol else {
                return Err(ParseError::syntax(start, format!("unexpected character `{}`", c.escape_debug())));
            };
            at += symbol.len();
            Token::Symbol(symbol)
        };
        tokens.push((start, token));
    }
    tokens.push((characters.len(), Token::End));
    Ok(tokens)
}

fn word(characters: &[char], at: &mut usize) -> String {
    let start = *at;
    while characters.get(*at).is_some_and(|c| c.is_ascii_alphanumeric() || *c == '_') {
        *at += 1;
    }
    characters[start..*at].iter().collect()
}

fn number(characters: &[char], at: &mut usize) -> Result<Token, ParseError> {
    let start = *at;
    let digits = |at: &mut usize| {
        while characters.get(*at).is_some_and(char::is_ascii_digit) {
            *at += 1;
        }
    };
    let digit_at = |i: usize| characters.get(i).is_some_and(char::is_ascii_digit);
    digits(at);
    let mut whole = true;
    if characters.get(*at) == Some(&'.') && digit_at(*at + 1) {
        whole = false;
        *at += 1;
        digits(at);
    }
    if matches!(characters.get(*at), Some('e' | 'E')) {
        let sign = usize::from(matches!(characters.get(*at + 1), Some('+' | '-')));
        if digit_at(*at + 1 + sign) {
            whole = false;
            *at += 1 + sign;
            digits(at);
        }
    }
    let text: String = characters[start..*at].iter().collect();
    if characters.get(*at).is_some_and(|c| c.is_alphanumeric() || *c == '_') {
        let rest = word(characters, at);
        let error =
            ParseError::syntax(start, format!("a name does not begin with a digit, and `{text}{rest}` is no number"));
        let help = "leave the unit out: numbers are in seconds, metres and radians";
        return Err(if UNITS.contains(&rest.as_str()) { error.with_help(help) } else { error });
    }
    if whole {
        let int = text.parse().map(Token::Int);
        return int.map_err(|_| ParseError::syntax(start, format!("{text} is too large for an int")));
    }
    match text.parse::<f64>() {
        Ok(x) if x.is_finite() => Ok(Token::Float(x)),
        _ => Err(ParseError::syntax(start, format!("{text} is not a finite number"))),
    }
}

fn quoted(characters: &[char], at: &mut usize) -> Result<Token, ParseError> {
    let start = *at;
    let quote = characters[start];
    let mut text = String::new();
    *at += 1;
    loop {
        match characters.get(*at) {
            None => return Err(ParseError::syntax(start, "this text has no closing quote")),
            Some(c) if *c == quote => break,
            Some('\\') => {
                *at += 1;
                match characters.get(*at) {
                    Some('n') => text.push('\n'),
                    Some('t') => text.push('\t'),
                    Some(c @ ('\\' | '"' | '\'')) => text.push(*c),
                    _ => return Err(ParseError::syntax(*at, "expected one of n t \\ \" ' after `\\`")),
                }
            }
            Some(c) => text.push(*c),
        }
        *at += 1;
    }
    *at += 1;
    Ok(Token::Text(text))
}
