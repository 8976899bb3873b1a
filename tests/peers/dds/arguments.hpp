// The command line of a peer: positions, and options that may come several times.
#pragma once

#include <cstdio>
#include <cstdlib>
#include <map>
#include <string>
#include <vector>

class Arguments {
public:
    Arguments(int count, char** words) {
        for (int at = 1; at < count; ++at) {
            const std::string word = words[at];
            if (word.rfind("--", 0) != 0) {
                positions_.push_back(word);
            } else if (at + 1 < count && std::string(words[at + 1]).rfind("--", 0) != 0) {
                options_[word.substr(2)].push_back(words[++at]);
            } else {
                options_[word.substr(2)];
            }
        }
    }

    // The position, or the end of the process with its name.
    std::string position(size_t at, const char* what) const {
        if (at >= positions_.size()) {
            fail(std::string("needs ") + what);
        }
        return positions_[at];
    }

    bool has(const std::string& name) const { return options_.count(name) > 0; }

    const std::vector<std::string>& all(const std::string& name) const {
        static const std::vector<std::string> none;
        const auto found = options_.find(name);
        return found == options_.end() ? none : found->second;
    }

    std::string text(const std::string& name, const std::string& otherwise) const {
        const auto& values = all(name);
        return values.empty() ? otherwise : values.back();
    }

    double number(const std::string& name, double otherwise) const {
        const auto& values = all(name);
        if (values.empty()) {
            return otherwise;
        }
        char* end = nullptr;
        const double value = std::strtod(values.back().c_str(), &end);
        if (end == values.back().c_str() || *end != '\0') {
            fail("--" + name + " is no number: " + values.back());
        }
        return value;
    }

    [[noreturn]] static void fail(const std::string& why) {
        std::fprintf(stderr, "peer: %s\n", why.c_str());
        std::_Exit(64);
    }

private:
    std::vector<std::string> positions_;
    std::map<std::string, std::vector<std::string>> options_;
};
