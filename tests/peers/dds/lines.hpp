// What a peer says, JSON objects on lines of standard output, and what ends it: SIGTERM, SIGINT, its limit, a line.
#pragma once

#include <atomic>
#include <chrono>
#include <condition_variable>
#include <csignal>
#include <cstdio>
#include <deque>
#include <mutex>
#include <optional>
#include <string>
#include <thread>
#include <unistd.h>

// A JSON object that is put together field by field and printed, at once, when it goes.
class Line {
public:
    Line& field(const char* name, const std::string& text) { return put(name, quoted(text)); }
    Line& field(const char* name, const char* text) { return put(name, quoted(text)); }
    Line& field(const char* name, bool value) { return put(name, value ? "true" : "false"); }
    template <typename Number> Line& field(const char* name, Number value) { return put(name, std::to_string(value)); }
    // `json` as it is.
    Line& put(const char* name, const std::string& json) {
        text_ += (text_.empty() ? "{" : ",") + quoted(name) + ":" + json;
        return *this;
    }

    ~Line() {
        static std::mutex one_at_a_time;
        const std::lock_guard<std::mutex> guard(one_at_a_time);
        text_ += "}\n";
        std::fwrite(text_.data(), 1, text_.size(), stdout);
        std::fflush(stdout);
    }

    static std::string quoted(const std::string& text) {
        std::string json = "\"";
        for (const char raw : text) {
            const auto byte = static_cast<unsigned char>(raw);
            if (raw == '"' || raw == '\\') {
                json += '\\';
                json += raw;
            } else if (byte < 0x20) {
                char escaped[8];
                std::snprintf(escaped, sizeof escaped, "\\u%04x", byte);
                json += escaped;
            } else {
                json += raw;
            }
        }
        return json + "\"";
    }

private:
    std::string text_;
};

class Lifetime {
public:
    // Ends the process on SIGTERM and SIGINT, and after `seconds` whatever it is doing.
    static void bound(double seconds) {
        std::signal(SIGTERM, [](int) { _exit(0); });
        std::signal(SIGINT, [](int) { _exit(0); });
        std::thread([seconds] {
            std::this_thread::sleep_for(std::chrono::duration<double>(seconds));
            std::fprintf(stderr, "peer: its %g s are over\n", seconds);
            _exit(3);
        }).detach();
        std::thread(listen).detach();
    }

    // Whether a line came on standard input. Its end is no line.
    static bool told() { return told_; }

    static void wait_until_told() {
        while (!told()) {
            std::this_thread::sleep_for(std::chrono::milliseconds(5));
        }
    }

    // The next line of standard input, for peers that are told more than to end; nothing once it has ended.
    static std::optional<std::string> line() {
        std::unique_lock<std::mutex> guard(lines_lock_);
        lines_changed_.wait(guard, [] { return !lines_.empty() || ended_; });
        if (lines_.empty()) {
            return std::nullopt;
        }
        const std::string line = lines_.front();
        lines_.pop_front();
        return line;
    }

private:
    static void listen() {
        std::string line;
        for (int byte = std::getchar(); byte != EOF; byte = std::getchar()) {
            if (byte != '\n') {
                line += static_cast<char>(byte);
                continue;
            }
            told_ = true;
            const std::lock_guard<std::mutex> guard(lines_lock_);
            if (lines_.size() < MOST_LINES) {
                lines_.push_back(line);
            }
            line.clear();
            lines_changed_.notify_all();
        }
        const std::lock_guard<std::mutex> guard(lines_lock_);
        ended_ = true;
        lines_changed_.notify_all();
    }

    static constexpr size_t MOST_LINES = 1024;
    static inline std::atomic<bool> told_ = false;
    static inline bool ended_ = false;
    static inline std::deque<std::string> lines_;
    static inline std::mutex lines_lock_;
    static inline std::condition_variable lines_changed_;
};
