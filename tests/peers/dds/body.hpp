// A sample after its encapsulation header, always CDR_LE, and std_msgs/String with a text that can be checked.
#pragma once

#include <cstdint>
#include <cstdio>
#include <cstring>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "arguments.hpp"

using Body = std::vector<uint8_t>;

inline Body of_hex(const std::string& hex) {
    Body body;
    for (size_t at = 0; at + 1 < hex.size(); at += 2) {
        const std::string pair = hex.substr(at, 2);
        if (pair.find_first_not_of("0123456789abcdefABCDEF") != std::string::npos) {
            Arguments::fail("no hexadecimal digits: " + pair);
        }
        body.push_back(static_cast<uint8_t>(std::stoi(pair, nullptr, 16)));
    }
    return body;
}

inline std::string hex(const Body& body) {
    static const char digits[] = "0123456789abcdef";
    std::string text;
    for (const uint8_t byte : body) {
        text += digits[byte >> 4];
        text += digits[byte & 15];
    }
    return text;
}

inline Body of_text(std::string_view text) {
    const auto length = static_cast<uint32_t>(text.size() + 1);
    Body body(4 + text.size() + 1);
    for (int at = 0; at < 4; ++at) {
        body[at] = static_cast<uint8_t>(length >> (8 * at));
    }
    std::memcpy(body.data() + 4, text.data(), text.size());
    return body;
}

// The text, if the body is that of a std_msgs/String, padded or not.
inline std::optional<std::string_view> text_of(const Body& body) {
    if (body.size() < 5) {
        return std::nullopt;
    }
    const uint32_t length = body[0] | body[1] << 8 | body[2] << 16 | static_cast<uint32_t>(body[3]) << 24;
    if (length == 0 || length > body.size() - 4 || body.size() - 4 - length > 3 || body[3 + length] != 0) {
        return std::nullopt;
    }
    return std::string_view(reinterpret_cast<const char*>(body.data()) + 4, length - 1);
}

// "SSSSSSSS CCCCCCCC " and filler: the number in decimal, and the FNV-1a of number and filler in hexadecimal.
class Numbered {
public:
    static constexpr size_t HEAD = 18;

    static std::string text(uint32_t number, size_t size) {
        if (size < HEAD) {
            Arguments::fail("--size is at least 18");
        }
        std::string filler(size - HEAD, ' ');
        for (size_t at = 0; at < filler.size(); ++at) {
            filler[at] = static_cast<char>('a' + (at * 7 + number) % 26);
        }
        char head[HEAD + 1];
        std::snprintf(head, sizeof head, "%08u %08x ", number % 100000000, sum(number % 100000000, filler));
        return head + filler;
    }

    // The number, if the text has one.
    static std::optional<uint32_t> number(std::string_view text) {
        if (text.size() < HEAD || text[8] != ' ' || text[17] != ' '
            || text.substr(0, 8).find_first_not_of("0123456789") != std::string_view::npos) {
            return std::nullopt;
        }
        return static_cast<uint32_t>(std::stoul(std::string(text.substr(0, 8))));
    }

    static bool is_whole(std::string_view text) {
        const auto found = number(text);
        char expected[9];
        std::snprintf(expected, sizeof expected, "%08x", sum(found.value_or(0), text.substr(HEAD)));
        return found && text.substr(9, 8) == expected;
    }

private:
    static uint32_t sum(uint32_t number, std::string_view filler) {
        uint32_t hash = 2166136261u;
        for (int shift = 0; shift < 32; shift += 8) {
            hash = (hash ^ (number >> shift & 255)) * 16777619u;
        }
        for (const char byte : filler) {
            hash = (hash ^ static_cast<uint8_t>(byte)) * 16777619u;
        }
        return hash;
    }
};
