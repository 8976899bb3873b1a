// The Fibonacci action of the ROS tutorials, server and client, as rmw_fastrtps and rcl_action make them.
#pragma once

#include "arguments.hpp"

// Accepts orders of 0 and more, sends the numbers 1 up to the order as feedback and succeeds with them; of an order of 100
// and more those up to 3, and then waits to be cancelled, which it agrees to. Order -1 is rejected, -2 aborted.
void action_serve(const Arguments& arguments);

// Sends a goal of each --order one after the other, awaits what becomes of it, and cancels one of 100 and more when its
// third number has come.
void action_call(const Arguments& arguments);
