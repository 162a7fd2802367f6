//! The commands of a `console` block, and what they printed.

/// A line that begins with `$ `, with the lines that continue it, and the lines below it.
pub(crate) struct Command {
    pub(crate) line: String,
    pub(crate) printed: String,
}

/// Of a block; none where its first line is no command.
pub(crate) fn commands(block: &str) -> Vec<Command> {
    let mut commands: Vec<Command> = Vec::new();
    for line in block.lines() {
        match (line.strip_prefix("$ "), commands.last_mut()) {
            (Some(line), _) => commands.push(Command { line: line.to_owned(), printed: String::new() }),
            (None, Some(last)) if last.line.ends_with('\\') && last.printed.is_empty() => {
                last.line = format!("{}{}", last.line.trim_end_matches('\\'), line.trim_start());
            }
            (None, Some(last)) => last.printed = format!("{}{line}\n", last.printed),
            (None, None) => {}
        }
    }
    commands
}

/// The simple commands of a line of a shell, as words. Quotes keep blanks together; `;`, `&`, `|` end a command; what is redirected
/// and what is behind ` #` is left out.
pub(crate) fn words(line: &str) -> Vec<Vec<String>> {
    let (mut commands, mut word, mut quote, mut begun) = (vec![Vec::new()], String::new(), None, false);
    let mut letters = line.chars().peekable();
    while let Some(letter) = letters.next() {
        match (quote, letter) {
            (Some(open), _) if letter == open => quote = None,
            (Some(_), _) => word.push(letter),
            (None, '\'' | '"') => (quote, begun) = (Some(letter), true),
            (None, '#') if !begun => break,
            (None, ' ') => end(&mut word, &mut begun, &mut commands),
            (None, ';' | '&' | '|') => {
                end(&mut word, &mut begun, &mut commands);
                commands.push(Vec::new());
            }
            (None, '>' | '<') => {
                end(&mut word, &mut begun, &mut commands);
                while letters.next_if_eq(&' ').is_some() {}
                while letters.next_if(|letter| !" ;&|".contains(*letter)).is_some() {}
            }
            (None, _) => {
                word.push(letter);
                begun = true;
            }
        }
    }
    end(&mut word, &mut begun, &mut commands);
    commands.retain(|command| !command.is_empty());
    commands
}

fn end(word: &mut String, begun: &mut bool, commands: &mut [Vec<String>]) {
    if std::mem::take(begun)
        && let Some(last) = commands.last_mut()
    {
        last.push(std::mem::take(word));
    }
}

/// Whether a program printed what the document shows. Blanks in a row are one. A line `…` stands for any lines; with `about`, every
/// number is like every other.
pub(crate) fn same(shown: &str, printed: &str, about: bool) -> bool {
    let line = |line: &str| {
        let line = line.split_whitespace().collect::<Vec<_>>().join(" ");
        if about { without_numbers(&line) } else { line }
    };
    let lines = |text: &str| text.lines().map(line).filter(|line| !line.is_empty()).collect::<Vec<_>>();
    fits(&lines(shown), &lines(printed))
}

fn fits(shown: &[String], printed: &[String]) -> bool {
    match (shown, printed) {
        ([], []) => true,
        ([any, rest @ ..], _) if any == "…" => (0..=printed.len()).any(|left_out| fits(rest, &printed[left_out..])),
        ([first, shown @ ..], [line, printed @ ..]) => first == line && fits(shown, printed),
        _ => false,
    }
}

fn without_numbers(line: &str) -> String {
    let mut text = String::new();
    for letter in line.chars() {
        match letter {
            '0'..='9' if text.ends_with('#') => {}
            '.' if text.ends_with('#') => {}
            '0'..='9' => text.push('#'),
            _ => text.push(letter),
        }
    }
    text
}
