//! Codes of findings.

/// Defines the codes of findings: an enumeration with a text and an explanation for each code.
#[macro_export]
macro_rules! finding_codes {
    ($(#[$doc:meta])* $codes:ident {
        $($name:ident = $text:literal, $explanation:literal;)*
    }) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
        #[non_exhaustive]
        pub enum $codes { $(#[doc = concat!($text, ": ", $explanation)] $name,)* }

        impl $codes {
            /// Every code, in ascending order.
            pub const ALL: &'static [Self] = &[$(Self::$name),*];

            /// Returns the text of the code, such as `M001`.
            #[must_use]
            pub const fn as_str(self) -> &'static str {
                match self { $(Self::$name => $text),* }
            }

            /// Returns the general meaning of the code and the remedy.
            #[must_use]
            pub const fn explanation(self) -> &'static str {
                match self { $(Self::$name => $explanation),* }
            }
        }

        impl std::fmt::Display for $codes {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str(self.as_str())
            }
        }
    };
}
